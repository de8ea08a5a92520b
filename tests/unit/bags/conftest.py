# SPDX-License-Identifier: Apache-2.0
"""The generator is a command beside its package, not an installed one."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3] / "bags"))
