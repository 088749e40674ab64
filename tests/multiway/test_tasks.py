from __future__ import annotations

import hashlib

import numpy as np
import pytest

from tests.multiway.stubs import write_scans
from utopic_cli.errors import InputError
from utopic_cli.io.scan import read_scan
from utopic_cli.multiway import tasks
from utopic_cli.multiway.tasks import Reader, ScanRef


@pytest.fixture
def refs(tmp_path, monkeypatch):
    """Five scans of 200 points, of which three may be held, and how often each is read from its file."""
    write_scans(tmp_path, [f"s{i}.ply" for i in range(5)])
    monkeypatch.setattr(tasks, "MOST_POINTS_HELD", 600)
    read = []

    def counted(path, seed):
        read.append(path.stem)
        return read_scan(path, seed=seed)

    monkeypatch.setattr(tasks, "read_scan", counted)
    paths = [tmp_path / f"s{i}.ply" for i in range(5)]
    return [ScanRef(path, hashlib.sha256(path.read_bytes()).hexdigest()) for path in paths], read


def test_a_worker_reads_a_scan_once_and_holds_only_so_many(refs):
    scans, read = refs
    reader = Reader(0)
    for _ in range(3):
        for scan in scans[:3]:
            assert np.isfinite(reader(scan).cloud.points).all()
    assert read == ["s0", "s1", "s2"]
    reader(scans[0])
    reader(scans[3])  # in place of s1, which was used longest ago
    assert len(reader._held) == 3
    reader(scans[0])
    reader(scans[1])
    assert read == ["s0", "s1", "s2", "s3", "s1"]


def test_two_scans_are_held_however_large(refs, monkeypatch):
    scans, read = refs
    monkeypatch.setattr(tasks, "MOST_POINTS_HELD", 1)
    reader = Reader(0)
    for scan in (*scans[:2], *scans[:2], scans[2]):
        reader(scan)
    assert read == ["s0", "s1", "s2"] and len(reader._held) == 2


def test_a_file_that_has_changed_since_is_refused(refs):
    scans, _ = refs
    scans[0].path.write_bytes(scans[1].path.read_bytes())
    with pytest.raises(InputError, match=r"s0\.ply: has changed since the batch began"):
        Reader(0)(scans[0])
