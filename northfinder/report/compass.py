"""The compass rose and the strip beneath it that shows the azimuth's interval enlarged, as SVG of numbers alone."""

from __future__ import annotations

import math

from markupsafe import Markup

from northfinder.report.axes import Axis

_RADIUS = 150.0
_STRIP_WIDTH, _STRIP_MARGIN = 320.0, 22.0
#: The strip reaches so many half intervals to either side.
_STRIP_REACH = 2.5


def rose(azimuth_deg: float, half_deg: float, *, grid_deg: float | None, magnetic_deg: float | None) -> Markup:
    """Return the rose with the azimuth, its 95 % interval as a wedge, and grid and magnetic north beside true north.

    Parameters
    ----------
    azimuth_deg, half_deg : float
        The azimuth and half its interval.
    grid_deg, magnetic_deg : float or None
        Directions of grid north and magnetic north from true north; not drawn if None.
    """
    parts = [f'<circle class="ring" r="{_RADIUS:g}"/>', _graduation()]
    parts += [
        _outside(angle, role) for angle, role in ((grid_deg, "two"), (magnetic_deg, "three")) if angle is not None
    ]
    parts += [_wedge(azimuth_deg, min(half_deg, 180.0)), _needle(azimuth_deg)]
    return Markup("".join(parts))  # noqa: S704  # made here, of numbers and letters of ours


def _at(angle_deg: float, radius: float) -> tuple[float, float]:
    angle = math.radians(angle_deg)
    return radius * math.sin(angle), -radius * math.cos(angle)


def _point(angle_deg: float, radius: float) -> str:
    x, y = _at(angle_deg, radius)
    return f"{x:.2f} {y:.2f}"


def _graduation() -> str:
    lines = {"fine": "", "coarse": ""}
    for angle in range(0, 360, 5):
        kind, inner = ("coarse", 138.0) if angle % 30 == 0 else ("fine", 146.0 if angle % 10 else 143.0)
        lines[kind] += f"M{_point(angle, inner)}L{_point(angle, _RADIUS)}"
    texts = []
    for angle in range(0, 360, 30):
        x, y = _at(angle, 122.0)
        cardinal = {0: "N", 90: "E", 180: "S", 270: "W"}.get(angle)
        kind = "cardinal" if cardinal else "degree"
        texts.append(f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" dy=".35em">{cardinal or angle}</text>')
    drawn = "".join(f'<path class="{kind}" d="{data}"/>' for kind, data in lines.items())
    return drawn + "".join(texts)


def _outside(angle_deg: float, role: str) -> str:
    """Return a small mark outside of the ring; by its role it is filled or not, so that no colour is needed."""
    return (
        f'<path class="north {role}" d="M{_point(angle_deg, 152.0)}L{_point(angle_deg - 2.2, 163.0)}'
        f'L{_point(angle_deg + 2.2, 163.0)}Z"/>'
    )


def _wedge(azimuth_deg: float, half_deg: float) -> str:
    low, high = azimuth_deg - half_deg, azimuth_deg + half_deg
    if half_deg >= 180.0:
        return f'<circle class="wedge" r="{_RADIUS:g}"/>'
    large = int(half_deg > 90.0)
    return (
        f'<path class="wedge" d="M0 0L{_point(low, _RADIUS)}A{_RADIUS:g} {_RADIUS:g} 0 {large} 1 '
        f'{_point(high, _RADIUS)}Z"/>'
    )


def _needle(azimuth_deg: float) -> str:
    body = f"M{_point(azimuth_deg, 107.0)}L{_point(azimuth_deg + 90.0, 5.0)}L{_point(azimuth_deg + 180.0, 26.0)}"
    head = f'<path class="centre" d="M{_point(azimuth_deg, 134.0)}L{_point(azimuth_deg, _RADIUS)}"/>'
    return f'{head}<path class="needle" d="{body}L{_point(azimuth_deg - 90.0, 5.0)}Z"/><circle class="hub" r="3"/>'


def strip(azimuth_deg: float, half_deg: float, *, truth_deg: float | None) -> Markup:
    """Return the neighbourhood of the azimuth, a few intervals wide, with the interval as a bar and the truth if known.

    A truth that lies further off is drawn at the end.
    """
    reach = max(_STRIP_REACH * half_deg, 1e-6)
    axis = Axis(azimuth_deg - reach, azimuth_deg + reach, directions=True)
    low, high = (_along(axis, azimuth_deg + k * half_deg) for k in (-1.0, 1.0))
    parts = [
        f'<path class="coarse" d="M{_STRIP_MARGIN:g} 26H{_STRIP_WIDTH - _STRIP_MARGIN:g}"/>',
        f'<rect class="bar" x="{low:.1f}" y="16" width="{high - low:.1f}" height="10"/>',
        f'<path class="centre" d="M{_along(axis, azimuth_deg):.1f} 11V26"/>',
    ]
    for value, text in _few(axis.ticks()):
        x = _along(axis, value)
        parts.append(f'<path class="fine" d="M{x:.1f} 26v5"/><text class="degree" x="{x:.1f}" y="43">{text}°</text>')
    if truth_deg is not None:
        off = math.remainder(truth_deg - azimuth_deg, 360.0)
        x = _along(axis, azimuth_deg + max(-reach, min(reach, off)))
        parts.append(f'<path class="truth" d="M{x:.1f} 15l4 -5l-4 -5l-4 5Z"/>')
    return Markup("".join(parts))  # noqa: S704  # made here, of numbers of ours


def _few(ticks: list[tuple[float, str]]) -> list[tuple[float, str]]:
    """Return every second tick where there are too many for their texts to stand side by side."""
    return ticks[:: -(-len(ticks) // 5)]


def _along(axis: Axis, value: float) -> float:
    return _STRIP_MARGIN + (_STRIP_WIDTH - 2.0 * _STRIP_MARGIN) * axis.place(value)
