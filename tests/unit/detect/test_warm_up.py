# SPDX-License-Identifier: Apache-2.0
"""What `make setup` has compiled is what finds pipes: the small scene goes through all stages, thin pipes included."""

from __future__ import annotations

from typing import Any

import pytest

from pipeprog_detect import warm_up
from pipeprog_detect.thin import thin_pipes
from pipeprog_detect.thin.axis_sweep import Proposal
from pipeprog_detect.types import Pipe


def test_the_scene_goes_through_all_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    detect, propose = warm_up.detect, thin_pipes.propose_parallel
    found: list[list[Pipe]] = []
    proposed: list[float] = []

    def detected(*args: Any, **kwargs: Any) -> list[Pipe]:
        found.append(detect(*args, **kwargs))
        return found[-1]

    def proposals(*args: Any, **kwargs: Any) -> list[Proposal]:
        lines = propose(*args, **kwargs)
        proposed.extend(line.cylinder.radius for line in lines)
        return lines

    monkeypatch.setattr(warm_up, "detect", detected)
    monkeypatch.setattr(thin_pipes, "propose_parallel", proposals)
    warm_up.warm_up()
    assert len(found) == 2  # with a global and a rolling shutter
    for pipes in found:
        cylinders = sorted((pipe.cylinder for pipe in pipes), key=lambda each: float(each.middle[0]))
        assert [each.radius for each in cylinders] == pytest.approx([each.radius for each in warm_up.THICK], abs=1e-3)
        assert [each.length for each in cylinders] == pytest.approx([each.length for each in warm_up.THICK], abs=5e-3)
    assert warm_up.THIN.radius in proposed
