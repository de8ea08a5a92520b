# SPDX-License-Identifier: Apache-2.0
"""The report as PDF: its page, printed by a browser that is installed, with the same tables and pictures."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from pipeprog_camera.errors import InputError

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge")
_LONGEST = 300  # s; a page of 15 MB takes 5 s


def browser() -> str:
    """The browser that prints; raises InputError where none is installed."""
    found = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if found is None:
        raise InputError(
            "--pdf prints the page with Chromium or Chrome, and none is installed: `apt-get install chromium`, or "
            "open the page in any browser and print it"
        )
    return found


def print_page(page: Path, pdf: Path) -> None:
    """Print an HTML file to `pdf`; raises InputError, with what the browser said, where it does not."""
    with tempfile.TemporaryDirectory() as home:
        command = [
            *(browser(), "--headless", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"),
            *("--disable-background-networking", f"--user-data-dir={home}", "--no-pdf-header-footer"),
            # Chromium's sandbox refuses to run as root; the page is our own and may load nothing.
            *(["--no-sandbox"] if os.geteuid() == 0 else []),
            *(f"--print-to-pdf={pdf}", page.resolve().as_uri()),
        ]
        try:
            done = subprocess.run(
                command, env={**os.environ, "HOME": home}, capture_output=True, timeout=_LONGEST, text=True
            )
        except subprocess.TimeoutExpired:
            raise InputError(f"{command[0]} has not printed {page} within {_LONGEST} s: print it by hand") from None
    if not pdf.is_file() or not pdf.stat().st_size:
        said = (done.stderr.strip().splitlines() or ["no word"])[-1]
        raise InputError(f"{command[0]} has not printed {page} ({said}): print it by hand")
