# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import random

from tests.fuzz.targets import targets


def test_every_target_makes_inputs() -> None:
    for target in targets().values():
        assert len({target.make(random.Random(seed)) for seed in range(9)}) > 3, target.name
