# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
from pathlib import Path

from benchmarks.write_reliability import PAGE, read_hostile, reliability
from pipeprog_camera import limits


def test_the_page_says_what_the_results_and_the_limits_say() -> None:
    assert PAGE.read_text() == reliability(read_hostile()), f"{PAGE}: run python -m benchmarks.write_reliability"


def test_every_limit_has_its_reason_on_the_page() -> None:
    named = re.findall(r"^([A-Z][A-Z_]+) = ", Path(limits.__file__).read_text(), re.MULTILINE)
    told = re.findall(r"^\| `([A-Z_]+)` \| [^|]+ \| [^|]+ \|$", PAGE.read_text(), re.MULTILINE)
    assert told == named
