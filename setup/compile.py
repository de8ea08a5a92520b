# SPDX-License-Identifier: Apache-2.0
"""Has Numba compile what the nodes compute with, beside each other; it keeps the code beside the sources."""

import subprocess
import sys

modules = [f"pipeprog_{package}.warm_up" for package in ("frames", "sfm", "detect")]
running = [subprocess.Popen([sys.executable, "-m", module]) for module in modules]
sys.exit(max(each.wait() for each in running))
