"""Write the tables of docs/accuracy.md from the stored fronts: python docs/make_accuracy.py (a test
holds the two together).

The fronts are made by `zonda accuracy PIPELINE --quick --store`, and the picture beside the page by
the same command.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PAGE = Path(__file__).with_name("accuracy.md")
FRONTS = Path(__file__).parents[1] / "pipelines" / "fronts"
MARK = "<!-- made by docs/make_accuracy.py from pipelines/fronts: do not edit below -->\n"


def page() -> str:
    """The page with its tables made anew."""
    written, _, _ = PAGE.read_text(encoding="utf-8").partition(MARK)
    fronts = [
        json.loads(path.read_text(encoding="utf-8")) for path in sorted(FRONTS.glob("*.json"))
    ]
    return written + MARK + "".join("\n".join(lines(front)) + "\n" for front in fronts)


def lines(front: dict[str, Any]) -> Iterator[str]:
    """One pipeline and metric."""
    reference = front["points"][0]
    shorter = ", ".join(f"{k} = {v}" for k, v in front["shorter"].items()) or "none"
    yield from ("", f"## {front['pipeline']}, {front['metric']}", "")
    yield (
        f"Error: {front['says']}. Shortened by: {shorter}. zonda {front['versions']['zonda']}, seed"
        f" {front['seed']}."
    )
    staying = " ".join(f"`{k}={v}`" for k, v in front["staying"].items())
    yield (
        f"Instrument noise in units of the error: {percent(front['noise_floor'])}; realization"
        f" scatter: {percent(front['realization_scatter'])}. Reference: {cost(reference)} CPU s,"
        f" {reference['memory'] / 1e6:.0f} MB; its own error by its last steps:"
        f" {percent(front['reference_error'])}, with {staying}."
    )
    picture = PAGE.with_name(f"accuracy_{front['pipeline']}_{front['metric']}.png")
    if picture.exists():
        yield from ("", f"![work-precision diagram]({picture.name})")
    yield from (
        "",
        "Each knob alone:",
        "",
        "| knob | value | error | CPU s | saved in its step, s | left at the tightest |",
    )
    yield "|---|---|---|---|---|---|"
    for alone in front["alone"]:
        last = alone["rungs"][-1]
        for rung in alone["rungs"]:
            error = "refused" if rung["error"] is None else percent(rung["error"])
            error += f" ± {percent(rung['resolution'])}" if rung["resolution"] else ""
            saved = (
                ""
                if rung is last
                else (
                    f"{last['own'] - rung['own']:+.3f} ±"
                    f" {(last['own_spread'] ** 2 + rung['own_spread'] ** 2) ** 0.5:.3f}"
                )
            )
            name = f"`{alone['knob']}`" if rung is alone["rungs"][0] else ""
            left = percent(alone["left"]) if rung is last else ""
            yield f"| {name} | {rung['value']} | {error} | {cost(rung)} | {saved} | {left} |"
    yield from (
        "",
        "The joint Pareto front:",
        "",
        "| error | CPU s | MB | what differs from the tightest |",
        "|---|---|---|---|",
    )
    for point in front["front"]:
        different = [
            f"`{k}={v}`" for k, v in point["setting"].items() if front["reference"].get(k) != v
        ]
        chosen = " (chosen)" if point == front["chosen"] else ""
        yield (
            f"| {percent(point['error'])}{chosen} | {cost(point)} | {point['memory'] / 1e6:.0f} |"
            f" {' '.join(different)} |"
        )
    present = front["present"]
    yield from ("", f"The file's own setting: {percent(present['error'])}, {cost(present)} CPU s.")


def percent(value: float | None) -> str:
    """Two digits."""
    return "none" if value is None else f"{100 * value:.{3 if value >= 1 else 2}g} %"


def cost(measured: dict[str, Any]) -> str:
    """CPU seconds and their spread."""
    return f"{measured['seconds']:.3g} ± {measured['spread']:.2g}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
