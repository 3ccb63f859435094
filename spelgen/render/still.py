"""The arm as a still picture in SVG: what a page shows without a script, and on paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from spelgen.render.scene import Scene

YAW, PITCH = 2.3, 0.36  # of the camera [rad]
WIDTH, HEIGHT, ROOM = 640, 420, 0.86
LIGHT = np.array([-0.35, 0.62, 0.7]) / np.linalg.norm([-0.35, 0.62, 0.7])
SHADES = 8


@dataclass(frozen=True)
class View:
    """What the camera looks at: the middle [m], and pixels per metre."""

    middle: tuple[float, float, float]
    scale: float


def view(scene: Scene, poses: Sequence[Sequence[float]]) -> View:
    """The view that holds the arm at all these positions."""
    points = np.concatenate(
        [vertices for q in poses for vertices, _ in _placed(scene, q) if len(vertices)] or [np.zeros((1, 3))]
    )
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    flat = (points - middle) @ camera().T
    across, up = np.abs(flat[:, 0]).max() or 1.0, np.abs(flat[:, 1]).max() or 1.0
    x, y, z = middle.tolist()
    return View((x, y, z), ROOM * min(WIDTH / 2 / across, HEIGHT / 2 / up))


def still(
    scene: Scene, seen: View, q: Sequence[float], ghosts: Sequence[Sequence[float]], title: str
) -> Markup:
    """The arm at q, and pale at other positions."""
    parts = [
        Markup('<svg class="still" viewBox="0 0 {} {}" role="img" aria-label="{}">').format(
            WIDTH, HEIGHT, title
        )
    ]
    for pose in ghosts:
        parts += [Markup('<g class="ghost">'), _faces(scene, seen, pose, outline=True), Markup("</g>")]
    return Markup("").join([*parts, _faces(scene, seen, q), Markup("</svg>")])


def camera() -> np.ndarray:
    """Takes the root's axes to right, up and towards the eye, (3, 3)."""
    c, s, cp, sp = np.cos(YAW), np.sin(YAW), np.cos(PITCH), np.sin(PITCH)
    return np.array([[-c, s, 0], [-s * sp, -c * sp, cp], [s * cp, c * cp, sp]])


def _placed(scene: Scene, q: Sequence[float]) -> list[tuple[np.ndarray, tuple[tuple[int, ...], ...]]]:
    frames = zip(scene.links, scene.frames(q), strict=True)
    return [
        (link.shape.vertices @ rotation.T + position, link.shape.faces)
        for link, (rotation, position) in frames
    ]


def _faces(scene: Scene, seen: View, q: Sequence[float], *, outline: bool = False) -> Markup:
    """Polygons from the farthest to the nearest (painter's algorithm), those that look away left out."""
    drawn: list[tuple[float, int, str]] = []
    for vertices, faces in _placed(scene, q):
        flat = (vertices - np.array(seen.middle)) @ camera().T
        for face in faces:
            corners = flat[list(face)]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
            size = np.linalg.norm(normal)
            if size == 0 or normal[2] <= 0:
                continue
            shade = round((SHADES - 1) * max(0.0, float(normal @ LIGHT / size)))
            path = " ".join(
                f"{WIDTH / 2 + seen.scale * x:.0f},{HEIGHT / 2 - seen.scale * y:.0f}" for x, y, _ in corners
            )
            drawn.append((float(corners[:, 2].mean()), shade, path))
    if outline:
        return Markup("").join(Markup('<polygon points="{}"/>').format(path) for _, _, path in drawn)
    return Markup("").join(
        Markup('<polygon class="s{}" points="{}"/>').format(shade, path) for _, shade, path in sorted(drawn)
    )
