"""The journal: what was recorded stays recorded, and what it shows is what it holds."""

from __future__ import annotations

import errno
import json
import sys

import pytest

from utopic_cli.errors import OutputError
from utopic_cli.training import journal as module
from utopic_cli.training.journal import Journal


def record(pairs, **values):
    return {"pairs": pairs, "of": 100, "stage": "joint", "elapsed_s": pairs / 2, "overlap": 0.5, **values}


def lines(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def scalars(out):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(out / "tensorboard"))
    events.Reload()
    return {
        tag: [(event.step, round(event.value, 4)) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
    }


def test_every_record_is_on_disk_at_once(tmp_path):
    with Journal(tmp_path, 0) as journal:
        journal.write(record(2))
        assert lines(tmp_path) == [record(2)]
        assert (tmp_path / "curves.html").is_file()  # there is something to open from the start
        journal.write(record(4))
        assert lines(tmp_path) == [record(2), record(4)] == journal.records


def test_an_ended_run_has_no_time_left(tmp_path):
    with Journal(tmp_path, 0) as journal:
        journal.write(record(2, left_s=600.0))
        assert "about 10 min left as of 20" in (tmp_path / "curves.html").read_text()
    assert "min left" not in (tmp_path / "curves.html").read_text()


def test_resuming_keeps_what_the_checkpoint_knows_and_drops_the_rest(tmp_path):
    with Journal(tmp_path, 0) as journal:
        for pairs in (2, 4, 6):
            journal.write(record(pairs, hit_rate=pairs / 10))
    with Journal(tmp_path, 4) as journal:
        assert [one["pairs"] for one in journal.records] == [2, 4]
        journal.write(record(6, hit_rate=0.9))
        journal.write(record(8))
    assert lines(tmp_path) == [
        record(2, hit_rate=0.2),
        record(4, hit_rate=0.4),
        record(6, hit_rate=0.9),
        record(8),
    ]
    assert scalars(tmp_path)["validation/hit_rate"] == [(2, 0.2), (4, 0.4), (6, 0.9)]
    page = (tmp_path / "curves.html").read_text()
    assert "8 of 100 pairs" in page and "90.0 %" in page


def test_a_new_run_starts_with_an_empty_journal(tmp_path):
    with Journal(tmp_path, 0) as journal:
        journal.write(record(2))
    with Journal(tmp_path, 0) as journal:
        journal.write(record(4))
    assert lines(tmp_path) == [record(4)]
    assert scalars(tmp_path)["loss/overlap"] == [(4, 0.5)]
    assert len(list((tmp_path / "tensorboard").glob("events.*"))) == 1  # whatever a reader's order


def test_a_half_written_last_line_is_dropped_in_silence(tmp_path, caplog):
    text = json.dumps(record(2)) + "\n" + json.dumps(record(4))[:-9]
    (tmp_path / "log.jsonl").write_text(text)
    with Journal(tmp_path, 4) as journal:
        journal.write(record(6))
    assert lines(tmp_path) == [record(2), record(6)]
    assert not caplog.records


def test_other_damage_is_left_out_and_told(tmp_path, caplog):
    text = f"{json.dumps(record(2))}\n[1, 2]\n\x00\x00\n{json.dumps(record(4))}\n"
    (tmp_path / "log.jsonl").write_text(text)
    with Journal(tmp_path, 4) as journal:
        assert journal.records == [record(2), record(4)]
    assert "left out 2 damaged lines, the first is line 2" in caplog.text


def test_events_have_a_tag_for_each_number_and_pairs_as_steps(tmp_path):
    with Journal(tmp_path, 0) as journal:
        journal.write(
            record(10, pairs_per_s=2.5, waiting=0.25, rate=0.001, gradient=3.0, left_s=9.0, hit_rate=0.125)
        )
    assert scalars(tmp_path) == {
        "loss/overlap": [(10, 0.5)],
        "speed/pairs_per_s": [(10, 2.5)],
        "speed/waiting": [(10, 0.25)],
        "optimiser/rate": [(10, 0.001)],
        "optimiser/gradient": [(10, 3.0)],
        "validation/hit_rate": [(10, 0.125)],
    }


def test_tensorboard_is_not_needed(tmp_path, monkeypatch):
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with Journal(tmp_path, 0) as journal:
        journal.write(record(2))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["curves.html", "log.jsonl"]


def test_the_page_is_written_once_a_minute_and_at_the_end(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    pages = []
    monkeypatch.setattr(module, "curves_page", lambda records, *_, **__: pages.append(len(records)) or "page")
    with Journal(tmp_path, 0) as journal:
        for seconds in (1, 20, 59, 62, 80, 121, 123):
            now[0] = seconds
            journal.write(record(seconds))
    assert pages == [1, 4, 7, 7]


def test_a_page_that_cant_be_written_ends_no_training(tmp_path, caplog):
    (tmp_path / "curves.html").mkdir()
    with Journal(tmp_path, 0) as journal:
        journal.write(record(2))
    assert lines(tmp_path) == [record(2)]
    assert caplog.text.count("curves.html") == 1


def test_a_full_disk_is_told_in_one_line_and_closing_hides_no_error(tmp_path):
    class Full:
        closed = False

        def write(self, text):
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self):
            raise OSError(errno.ENOSPC, "No space left on device")

    told = r"log\.jsonl: can't be written \(No space left on device\); mend that and go on with --resume"
    with pytest.raises(OutputError, match=told), Journal(tmp_path, 0) as journal:
        journal._lines.close()
        journal._lines = Full()
        journal.write(record(2))
