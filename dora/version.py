"""Which Dora this is: the version of the package and the commit that it was made from."""

import subprocess
from pathlib import Path

PACKAGE = Path(__file__).parent
"""Folder of the package."""
COMMIT_FILE = "_commit"
"""File in the package that names the commit; only a built wheel has it."""
NAME = "dora"
"""Name of the package and of its command; that of the distribution is in pyproject.toml, because another project has
this one on the index."""
VERSION = "0.1.0"
"""Version of the package; pyproject.toml takes it from here."""


def source_commit(package: Path = PACKAGE) -> str | None:
    """Commit of the checkout that runs, with "-dirty" if files of it have changed, or of the installed wheel; None if
    neither is known."""
    stored, root = package / COMMIT_FILE, package.parent
    if stored.is_file():
        return stored.read_text().strip() or None
    return described(root) if (root / ".git").exists() else None


def described(root: Path) -> str | None:
    """Commit of a checkout as git describes it; None if git does not tell."""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def version_line() -> str:
    """Version and commit for people, such as "dora 0.1.0 (commit 0123456789ab)"."""
    commit = source_commit()
    return f"{NAME} {VERSION}" + (f" (commit {commit})" if commit else "")
