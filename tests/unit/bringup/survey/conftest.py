# SPDX-License-Identifier: Apache-2.0
"""The stage of the node `survey`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeprog_bringup.survey import passage
from tests.unit.bringup.survey.survey_stage import SurveyStage, survey_stage


@pytest.fixture(autouse=True)
def _no_connections_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fake nodes do not subscribe to each other."""
    monkeypatch.setattr(passage, "missing_connections", lambda *_: [])


@pytest.fixture
def surveys(tmp_path: Path) -> Iterator[SurveyStage]:
    """The node `survey` with the bill and the board of the demo; its folders are in `surveys`."""
    with survey_stage(tmp_path / "surveys") as stage:
        yield stage
