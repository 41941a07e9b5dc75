"""What a new user does with a real service: the curl lines of the documentation, Control-C, and commands over HTTP."""

from __future__ import annotations

import json
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from astropy.io import fits

from tests.conftest import REPOSITORY, write_image, write_psf
from tests.whole.stack import Stack, wait_for

COMMAND = (sys.executable, "-m", "service.cli")


def test_the_service_says_what_to_open_in_a_browser(open_stack: Stack) -> None:
    assert open_stack.said().splitlines()[1] == f"Open {open_stack.client.server} in a browser."


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is missing")
def test_the_curl_lines_of_the_documentation_work(open_stack: Stack, tmp_path: Path) -> None:
    [lines] = re.findall(r"```sh\n(.+?)```", (REPOSITORY / "docs" / "http.md").read_text("utf-8"), flags=re.S)
    assert lines.count("curl ") == 6 and lines.startswith("S=http://127.0.0.1:8765 ")
    write_psf(tmp_path / "psf.fits", size=256)
    described = {"instrument": "hri_euv", "channel": "174", "kind": "total"}
    psf = open_stack.client.upload_psf(tmp_path / "psf.fits", **described)
    times = {"valid_from": "2020-01-01", "valid_to": "2021-01-01"}  # not those of other tests' images
    open_stack.client.certify_psf(psf["id"], "1.0.0", **times)
    open_stack.client.psf_curve(psf["id"])  # makes the tables, which a built PSF has from the start
    write_image(
        tmp_path / "IMAGE.fits", DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV", WAVELNTH=174.0,
        **{"DATE-BEG": "2020-05-05"},
    )  # fmt: skip
    script = lines.replace("http://127.0.0.1:8765", open_stack.client.server)
    done = subprocess.run(
        ["bash", "-eu", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["radii_px"] == [1, 10, 100] and answer["shape"] == [256, 256]
    assert fits.getval(tmp_path / "OUT.fits", "PSFID") == psf["id"]
    assert "event: end" in (tmp_path / "events.txt").read_text()


def test_control_c_leaves_the_job_and_the_commands_that_it_names_work(
    open_stack: Stack, tmp_path: Path
) -> None:
    write_image(tmp_path / "large.fits", shape=(2048, 2048), OBSERVER=tmp_path.name)
    write_psf(tmp_path / "psf.fits")
    image = open_stack.client.upload_image(tmp_path / "large.fits")["id"]
    psf = open_stack.client.upload_psf(tmp_path / "psf.fits")["id"]
    method = {"name": "richardson-lucy", "steps": 200}
    job: str = open_stack.client.submit("deconvolve", image_id=image, psf_id=psf, method=method)["id"]
    wait_for(lambda: open_stack.client.job(job)["progress"]["step"] > 1, "the job is at work")
    address = open_stack.client.server.removeprefix("http://")
    terminal, other_end = pty.openpty()
    waiting = subprocess.Popen(
        [*COMMAND, "job", "wait", job[:12], "--server", address],
        stderr=other_end,
        stdout=subprocess.DEVNULL,
        # A shell starts commands in the background with SIGINT ignored, and the tests may run there.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    os.close(other_end)
    shown = b""
    while b"deconvolving" not in shown:  # the bar: the command has begun to wait
        shown += os.read(terminal, 1000)
    waiting.send_signal(signal.SIGINT)
    rest = b""
    with suppress(OSError):  # Linux's way to tell the end of a terminal
        while True:
            rest += os.read(terminal, 1000)
    os.close(terminal)
    told = rest.decode().replace("\r\n", "\n")
    assert waiting.wait(60) == 130, told
    assert f"interrupted; job {job[:12]} goes on" in told and "Traceback" not in told
    assert open_stack.client.job(job)["phase"] == "EXECUTING"
    cancel = re.findall(r"cancel it: +heliopsf (.+)", told)[0].split()
    assert cancel == ["job", "cancel", job[:12], "--server", open_stack.client.server]
    assert subprocess.run([*COMMAND, *cancel], timeout=60, check=False).returncode == 0
    rejoin = re.findall(r"again: +heliopsf (.+)", told)[0].split()
    ended = subprocess.run([*COMMAND, *rejoin], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 1 and f"job {job[:12]}: ABORTED" in ended.stderr


@pytest.mark.slow
def test_the_command_line_over_http_and_local_agree(
    open_stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    write_image(tmp_path / "image.fits", seed=7)
    command = [sys.executable, "-m", "service.cli", "deconvolve", str(tmp_path / "image.fits")]
    ways = {"remote": ["--server", open_stack.client.server], "local": ["--local"]}
    for name, way in ways.items():
        output = ["--psf", str(psf_file), "-o", str(tmp_path / f"{name}.fits")]
        subprocess.run([*command, *output, *way], check=True)
    assert (tmp_path / "remote.fits").read_bytes() == (tmp_path / "local.fits").read_bytes()
