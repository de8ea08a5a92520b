# SPDX-License-Identifier: Apache-2.0
"""What the files of a results folder must look like."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator

SCHEMA = Path(__file__).parents[1] / "docs" / "pipes.schema.json"


def faults_of_pipes(content: Any) -> list[str]:
    """What docs/pipes.schema.json objects to in the content of a pipes.json, one line a fault."""
    validator = Draft202012Validator(json.loads(SCHEMA.read_text()))
    return [f"{error.json_path}: {error.message}" for error in validator.iter_errors(content)]
