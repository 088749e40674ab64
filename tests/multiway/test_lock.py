from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from utopic_cli.errors import OutputError
from utopic_cli.multiway.lock import NAME, locked

HOLD = "import sys, time; from pathlib import Path; from utopic_cli.multiway.lock import locked\n"
HOLD += "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"


def test_two_in_one_folder_are_refused_and_the_holder_is_named(tmp_path):
    with locked(tmp_path):
        named = rf"another batch is at work there \(process {os.getpid()} on "
        with pytest.raises(OutputError, match=named), locked(tmp_path):
            pass
        (tmp_path / "other").mkdir()
        with locked(tmp_path / "other"):
            pass
    with locked(tmp_path):
        pass
    assert not (tmp_path / NAME).exists()


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_the_lock_of_a_killed_process_is_no_lock(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(OutputError, match=f"process {holder.pid} "), locked(tmp_path):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    holder.stdout.close()
    assert json.loads((tmp_path / NAME).read_bytes())["pid"] == holder.pid  # left behind
    begin = time.monotonic()
    with locked(tmp_path):
        assert json.loads((tmp_path / NAME).read_bytes())["pid"] == os.getpid()
    assert time.monotonic() - begin < 1.0


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(OutputError, match="can't be written"), locked(tmp_path / "none"):
        pass
