"""Ctrl-C ends compiled runs, however long they are."""

import signal
import subprocess
import sys

import pytest

from sympflow.lazy import whole_import

SCRIPT = """
import os, signal, threading
import numpy as np
from sympflow import solve, systems

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background inherits that it is ignored
hh, fput = systems.henon_heiles(), systems.fput(omega=50.0)
pair = hh.domain.sample(70, 0)
cases = [
    (hh, "verlet", hh.y0, {"dt": 1e-2}, 1e9),
    (hh, "kahan_li8", pair, {"dt": 1e-2}, 1e8),
    (hh, "verlet", hh.y0, {"dt": 1e-2, "compensated": True}, 1e9),
    (hh, "sympflow", hh.y0, {"tol": 1e-4}, 1e11),
    (hh, "sympflow", hh.y0, {}, 1e9),
    (hh, "gauss_legendre4", hh.y0, {"dt": 1e-2}, 1e8),
    (fput, "linear_srkn6b", fput.y0, {"dt": 1e-2}, 1e8),
    (fput, "sympflow", np.stack([fput.y0] * 9), {}, 1e9),
]
for system, method, y0, options, t_end in cases:
    t_eval = [system.dt]
    solve(system, method, (0, t_end), y0, t_eval=t_eval, **options)  # compiled
    timer = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        solve(system, method, (0, t_end), y0, t_eval=[t_end], **options)
    except KeyboardInterrupt:
        print(method, "interrupted", flush=True)
    timer.join()
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="os.kill ends the process there")
def test_compiled_runs_can_be_interrupted():
    found = subprocess.run([sys.executable, "-c", SCRIPT], check=False, capture_output=True, text=True, timeout=120)
    assert found.returncode != -signal.SIGINT, found.stderr
    assert found.stdout.split().count("interrupted") == 8, found.stderr


def test_an_import_is_not_cut_in_two(tmp_path, monkeypatch):
    (tmp_path / "slowly_loaded.py").write_text(
        "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nlast = 1\n", encoding="utf-8"
    )
    monkeypatch.syspath_prepend(tmp_path)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            whole_import("slowly_loaded")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert sys.modules["slowly_loaded"].last == 1
