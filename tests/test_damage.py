"""Damaged files of every loader end in a sentence: nothing that has a digest or a checksum is accepted, no traceback.

`python tests/damage.py 200` does the same with more files and prints figures.
"""

import random
from pathlib import Path

import pytest
import torch
from damage import Loader, Outcome, Probe, probe
from hypothesis import given, settings
from hypothesis.strategies import randoms
from probes import CONFIG, LOADERS, write_checkpoint

from dora.agents.checkpoint import read_checkpoint
from dora.errors import InputError
from dora.files import FIRST, WHOLE, read_tensors, write_tensors

COUNT = {"report": 4, "mesh .obj": 60}
"""Damaged files of the loader that draws figures, and of one that fails rarely; 40 for the others."""
RESULTS = Path(__file__).parents[1] / "results"
POLICIES = sorted(RESULTS.rglob("*.safetensors"))


@pytest.mark.parametrize("name", LOADERS)
def test_damaged_files_are_refused_in_one_sentence(name: str, tmp_path: Path):
    """Hypothesis draws what is damaged where, and shows the smallest damage that gets through."""
    one = Probe(name, LOADERS[name], tmp_path)

    @settings(max_examples=COUNT.get(name, 40), deadline=None, derandomize=True, database=None)
    @given(randoms(use_true_random=False))
    def damage(draw: random.Random) -> None:
        one.outcome = Outcome()
        one.damage(draw)
        assert one.outcome.tracebacks == []
        assert one.outcome.unclear == []
        assert not (LOADERS[name].sealed and one.outcome.accepted)
        assert not one.outcome.despite
        assert one.outcome.slowest < 5
        assert one.outcome.grown < 1000

    damage()


def test_the_probes_notice_what_is_accepted_and_what_is_a_traceback(tmp_path: Path):
    """The tool itself, on a loader that takes everything and on one that takes nothing."""

    def make(folder: Path) -> None:
        (folder / "file").write_text("content 1")

    def careless(folder: Path) -> None:
        assert (folder / "file").read_text(errors="replace") == "content 1"

    outcome = probe("all", Loader(make, lambda folder: None), 10, tmp_path / "all")
    assert (outcome.accepted, outcome.despite, outcome.tracebacks) == (outcome.probes, outcome.probes, [])
    outcome = probe("none", Loader(make, careless), 10, tmp_path / "none")
    assert len(outcome.tracebacks) == 2 * outcome.probes > 0


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'\\"gamma\\": 0.98', b'\\"gamma\\": 0.18'),
        (b'\\"total_steps\\": 300000', b'\\"total_steps\\": 900000'),
        (b'\\"env_steps\\": 100', b'\\"env_steps\\": 999'),
        (b"[7, 3]", b"[6, 4]"),
        (b'"version":"2"', b'"version":"1"'),
    ],
)
def test_a_header_that_was_changed_by_hand_is_noticed(tmp_path: Path, old: bytes, new: bytes):
    write_checkpoint(tmp_path)
    path = tmp_path / "a.safetensors"
    content = path.read_bytes()
    assert content.count(old) == 1
    path.write_bytes(content.replace(old, new))
    with pytest.raises(InputError, match="digest differs"):
        read_checkpoint(path)


def test_there_are_policies_of_both_formats():
    assert {WHOLE.encode() in path.read_bytes() for path in POLICIES} == {True, False}


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.parent.name)
def test_policies_of_any_format_load_and_their_settings_are_compared(path: Path, tmp_path: Path):
    content = path.read_bytes()
    assert (FIRST if WHOLE.encode() not in content else WHOLE).encode() in content
    assert read_checkpoint(path).config.env == path.parents[1].name
    gamma = b'\\"gamma\\": 0.9'
    assert content.count(gamma) == 1
    (tmp_path / "a.safetensors").write_bytes(content.replace(gamma, b'\\"gamma\\": 0.8'))
    with pytest.raises(
        InputError, match="digest differs" if WHOLE.encode() in content else "settings that were changed"
    ):
        read_checkpoint(tmp_path / "a.safetensors")


def test_settings_of_a_checkpoint_are_compared_with_their_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(type(CONFIG), "digest", lambda self: "0" * 12)
    write_checkpoint(tmp_path)
    with pytest.raises(InputError, match="settings that were changed"):
        read_checkpoint(tmp_path / "a.safetensors")


def test_every_byte_of_a_file_counts(tmp_path: Path):
    """Those that fill up the header as well."""
    path, name = tmp_path / "a.safetensors", "x"
    while not (content := path.read_bytes() if path.exists() else b"").count(b" " * 4):
        write_tensors(path, "dora-test 1", {"a": torch.arange(5.0)}, {"name": name})
        name += "x"
    for place in range(len(content)):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x29]) + content[place + 1 :])
        with pytest.raises(InputError):
            read_tensors(path, "dora-test 1")
