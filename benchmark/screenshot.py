"""TensorBoard's page of the thesis's figures as a picture, taken from real logs in headless Chromium.

    python benchmark/screenshot.py runs benchmark/results/tensorboard.png

Starts TensorBoard on the logs, opens its custom scalars (the layout that the scripts write), and ends it again. It
needs Chromium or Chrome on the PATH.
"""

import contextlib
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from dataclasses import dataclass
from pathlib import Path

import tyro

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from bookkeeping import parse, refuse, tell

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@dataclass
class Args:
    logdir: tyro.conf.Positional[Path]
    """directory with run directories"""
    picture: tyro.conf.Positional[Path]
    """PNG file to write"""
    width: int = 1500
    """of the browser's window, pixels"""
    height: int = 760
    """of the browser's window, pixels"""


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("localhost", 0))
        return sock.getsockname()[1]


def wait_for(url: str, server: subprocess.Popen, seconds: float = 60) -> bool:
    """Waits until the server answers; returns False if it ends, or does not within the time."""
    deadline = time.monotonic() + seconds
    while server.poll() is None and time.monotonic() < deadline:
        with contextlib.suppress(OSError):
            return urllib.request.urlopen(url).status == 200
        time.sleep(0.5)
    return False


def main() -> None:
    args = parse(Args, description=__doc__)
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        refuse(" or ".join(BROWSERS), "none is installed")
    if not any(args.logdir.rglob("events.out.tfevents*")):
        refuse(str(args.logdir), "no event files in it")
    port = free_port()
    module = [sys.executable, "-m", "tensorboard.main", "--logdir", str(args.logdir), "--port", str(port)]
    # --load_fast=false: the other reader shows a part of the points at first, and the picture would come too early
    with subprocess.Popen([*module, "--load_fast=false"], stderr=subprocess.DEVNULL) as server:
        try:
            # Its runs are listed once the event files have been read
            if not wait_for(f"http://localhost:{port}/data/runs", server):
                sys.exit("TensorBoard does not start")
            time.sleep(10)
            url = f"http://localhost:{port}/#custom_scalars"
            flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
            # The page draws itself after it has loaded: the browser's clock runs half a minute ahead, at once
            flags += ["--virtual-time-budget=30000", f"--window-size={args.width},{args.height}"]
            flags += [f"--screenshot={args.picture}"]
            subprocess.run([browser, *flags, url], stderr=subprocess.DEVNULL, check=True)
        finally:
            server.terminate()
    tell(str(args.picture))


if __name__ == "__main__":
    main()
