"""Welds as real pipes have them, seen by a scanner, with their truth: what a verdict is tried on.

`draw(kind, seed)` gives a `Scene` of a named kind, `views(scene)` its clouds, `record(scene, folder)` a whole session
with fringe images, `truth(scene)` the step between the two walls' surfaces at the toes. Nothing here is taken from what
the measuring side assumes of a weld: the surface is a height field made of parts that pipes have (docs/simulator.md).
"""

from weldscan.simulated.scenes.clouds import DARK, NO_FIT, OK, ORDER, SATURATED, Shot, views
from weldscan.simulated.scenes.drawing import draw
from weldscan.simulated.scenes.kinds import KINDS, Kind
from weldscan.simulated.scenes.scene import Scene, View, limit_for, scanner_for
from weldscan.simulated.scenes.seen_arc import seen_arc
from weldscan.simulated.scenes.session import record, session_document
from weldscan.simulated.scenes.truth import toes, truth
from weldscan.simulated.scenes.welds import (
    Cap,
    Counterbore,
    Dent,
    Flare,
    Harmonic,
    SceneWall,
    SceneWeld,
    SecondSeam,
    Spatter,
    Strip,
    Taper,
    Wander,
    Waviness,
    surface_of,
)

__all__ = [
    "DARK",
    "KINDS",
    "NO_FIT",
    "OK",
    "ORDER",
    "SATURATED",
    "Cap",
    "Counterbore",
    "Dent",
    "Flare",
    "Harmonic",
    "Kind",
    "Scene",
    "SceneWall",
    "SceneWeld",
    "SecondSeam",
    "Shot",
    "Spatter",
    "Strip",
    "Taper",
    "View",
    "Wander",
    "Waviness",
    "draw",
    "limit_for",
    "record",
    "scanner_for",
    "seen_arc",
    "session_document",
    "surface_of",
    "toes",
    "truth",
    "views",
]
