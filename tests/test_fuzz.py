"""Bad files of every format, a sample; `python tests/fuzz.py` makes more."""

import subprocess
import sys
from pathlib import Path


def test_fuzz__every_bad_file_is_refused_in_one_line_within_its_memory_and_time():
    command = [sys.executable, str(Path(__file__).with_name("fuzz.py")), "--files", "40"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    assert done.stdout.count(" files, 0 complaints") == 16
