"""Building of the wheel: the commit that it is made from goes into it, for `dora --version` and for result files."""

import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

DESCRIBE = ("git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
"""Names a commit as `dora.version.described` does."""


class CommitHook(BuildHookInterface):
    """Adds the file `dora/_commit` to wheels other than editable ones, which are described when they run."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable" or not (Path(self.root) / ".git").exists():
            return
        try:
            found = subprocess.run(DESCRIBE, cwd=self.root, capture_output=True, text=True, check=True, timeout=10)
        except (OSError, subprocess.SubprocessError):
            return
        self._folder = tempfile.TemporaryDirectory()
        path = Path(self._folder.name) / "commit"
        path.write_text(found.stdout)
        build_data["force_include"][str(path)] = "dora/_commit"
