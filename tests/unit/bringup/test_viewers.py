# SPDX-License-Identifier: Apache-2.0
"""The layouts for viewers show topics that out.mcap has."""

from __future__ import annotations

import json
import re
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[3]
VIEWERS = ROOT / "src" / "pipeprog_bringup" / "viewers"


def recorded() -> set[str]:
    """Topics of out.mcap, as docs/files.md lists them."""
    text = (ROOT / "docs" / "files.md").read_text()
    section = text[text.index("### `out.mcap`") : text.index("### `config.yaml`")]
    return set(re.findall(r"`(/[a-z_/]+)`", section))


def test_rviz_shows_topics_of_a_survey_and_late_ones_too() -> None:
    manager = yaml.safe_load((VIEWERS / "pipeprog.rviz").read_text())["Visualization Manager"]
    topics = {display["Topic"]["Value"]: display["Topic"] for display in manager["Displays"] if "Topic" in display}
    # RViz takes the compressed image by the name of the raw one.
    assert {name.replace("/keyframes/image", "/keyframes/image/compressed") for name in topics} <= recorded()
    for name in ("/map_points", "/pipe_markers", "/keyframe_poses"):
        assert topics[name]["Durability Policy"] == "Transient Local"
    assert manager["Global Options"]["Fixed Frame"] == "map"


def test_foxglove_shows_topics_of_a_survey() -> None:
    layout = json.loads((VIEWERS / "pipeprog.foxglove.json").read_text())
    panels = layout["configById"]
    topics = {topic for panel in panels.values() for topic in panel.get("topics", {})}
    image = panels["Image!pipeprog"]["imageMode"]
    topics |= {image["imageTopic"], image["calibrationTopic"], *image["annotations"]}
    topics |= {panel["topicPath"].split(".")[0] for panel in panels.values() if "topicPath" in panel}
    assert topics <= recorded()

    def leaves(node: object) -> set[str]:
        return leaves(node["first"]) | leaves(node["second"]) if isinstance(node, dict) else {str(node)}

    assert leaves(layout["layout"]) == set(panels)
