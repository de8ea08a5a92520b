# SPDX-License-Identifier: Apache-2.0
"""DXF: the axes of the pipes as lines in space, a layer for each class, each with its id.

The one module that imports ezdxf, which is an extra.
"""

from __future__ import annotations

import re
from pathlib import Path

from pipeprog_bringup.export.survey import Survey
from pipeprog_bringup.results.results_reader import UNPLANNED
from pipeprog_camera.errors import InputError

_INSTALL = "DXF needs ezdxf: `pip install ezdxf==1.4.2` (or `make setup EXCHANGE=1`)"
_NOT_IN_NAMES = re.compile(r'[<>/\\":;?*|=\'`,]')  # what no layer of AutoCAD may be called
_HEIGHT = 0.05  # m of the letters: legible at 1 : 50, where they are 1 mm
_METRES = 6  # $INSUNITS


def write_dxf(survey: Survey, path: Path) -> None:
    """Writes the axes in metres (DXF R2010); raises InputError where ezdxf is not installed."""
    try:
        import ezdxf
    except ImportError:
        raise InputError(_INSTALL) from None
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True  # no clock and no random ids: the same bytes each time
    try:
        document = ezdxf.new("R2010", units=_METRES)
        for pipe in survey.pipes:
            layer = _NOT_IN_NAMES.sub("_", pipe.class_name) or "unplanned"
            if layer not in document.layers:
                color = survey.results.colors.get(pipe.class_name, UNPLANNED)
                document.layers.add(layer).rgb = tuple(round(255 * part) for part in color)
            space = document.modelspace()
            start, end, middle = (
                tuple(map(float, at)) for at in (pipe.cylinder.start, pipe.cylinder.end, pipe.cylinder.middle)
            )
            space.add_line(start, end, {"layer": layer})
            space.add_text(pipe.id, height=_HEIGHT, dxfattribs={"layer": layer, "insert": middle})
        document.saveas(path)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before
