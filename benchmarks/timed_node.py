# SPDX-License-Identifier: Apache-2.0
"""A node that writes down how long its longest turn has taken: a wait of 0.1 s at the most, and a callback.

python -m benchmarks.timed_node FILE MODULE ARGUMENT...

FILE then holds seconds; MODULE is that of the node.
"""

from __future__ import annotations

import runpy
import sys
import time
from pathlib import Path
from typing import Any

from rclpy.executors import SingleThreadedExecutor


def write_longest_turn(file: Path) -> None:
    """Has the executors of this process write their longest turn so far to a file."""
    spin_once = SingleThreadedExecutor.spin_once
    longest = 0.0

    def timed(*arguments: Any, **options: Any) -> None:
        nonlocal longest
        began = time.monotonic()
        spin_once(*arguments, **options)
        spent = time.monotonic() - began
        if spent > longest:
            longest = spent
            whole = file.with_suffix(".new")
            whole.write_text(f"{longest:.3f}\n")
            whole.replace(file)

    SingleThreadedExecutor.spin_once = timed


if __name__ == "__main__":
    write_longest_turn(Path(sys.argv[1]))
    sys.argv = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
