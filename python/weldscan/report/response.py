"""The projector's response as a picture: light over level, the straight line that it should be, and the correction."""

from __future__ import annotations

import numpy as np

from weldscan.records.response import Response

WIDTH, HEIGHT, MARGIN = 520, 420, 56


def response_svg(response: Response) -> str:
    """Return an SVG of the response."""
    table = response.table()
    across, up = WIDTH - 2 * MARGIN, HEIGHT - 2 * MARGIN

    def at(level: float, light: float) -> str:
        return f"{MARGIN + across * level / 255:.1f},{HEIGHT - MARGIN - up * light:.1f}"

    curve = " ".join(at(v, float(table[v])) for v in range(256))
    wanted = np.linspace(0, 1, 128)
    inverse = np.interp(wanted, table, np.arange(256))
    correction = " ".join(at(255 * w, float(v) / 255) for w, v in zip(wanted, inverse, strict=True))
    span = response.light[-1] - response.light[0]
    dots = ""
    if response.method == "ramp":
        scaled = ((v - response.light[0]) / span for v in response.light)
        places = (at(level, light).split(",") for level, light in zip(response.level, scaled, strict=True))
        dots = "".join(f'<circle cx="{x}" cy="{y}" r="3" fill="#1f6feb"/>' for x, y in places)
    grid = "".join(
        f'<path d="M{at(v, 0)} L{at(v, 1)} M{at(0, v / 255)} L{at(255, v / 255)}" stroke="#d0d7de" stroke-width="0.7"/>'
        f'<text x="{at(v, 0).split(",")[0]}" y="{HEIGHT - MARGIN + 16}" text-anchor="middle">{v}</text>'
        f'<text x="{MARGIN - 8}" y="{HEIGHT - MARGIN - up * v / 255 + 4:.1f}" text-anchor="end">{v / 255:.2g}</text>'
        for v in (0, 51, 102, 153, 204, 255)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" '
        'font-size="12">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>{grid}'
        f'<path d="M{at(0, 0)} L{at(255, 1)}" stroke="#8b949e" stroke-dasharray="4 4"/>'
        f'<polyline points="{correction}" fill="none" stroke="#2da44e" stroke-width="1.5"/>'
        f'<polyline points="{curve}" fill="none" stroke="#1f6feb" stroke-width="2"/>{dots}'
        f'<text x="{MARGIN}" y="24" font-size="15">Light over level: like a gamma of {response.gamma:.3f}</text>'
        f'<text x="{MARGIN}" y="42" fill="#57606a">blue: seen ({response.method}); '
        "green: level to show for a wanted one</text>"
        f'<text x="{WIDTH / 2}" y="{HEIGHT - 12}" text-anchor="middle">level</text></svg>\n'
    )
