"""A study as lines of text and as the work-precision diagram; a setting as what to write into a
pipeline file, and what to type.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping
from typing import Any

from ..canvas import SEQUENCE, new_axes
from ..tables import aligned
from .bench import differences
from .pareto import Point, Study, least
from .settings import overrides
from .sweep import Alone

LONGEST = 88
"""Characters of a setting in the table of the front; a longer one is cut."""


def lines(study: Study) -> Iterator[str]:
    """The whole report, top down: what was measured, each knob alone, the Pareto front, the
    recommendation.
    """
    if study.interrupted:
        yield f"interrupted after {study.runs} runs: what follows is the Pareto front so far"
    yield from _heading(study)
    for alone in study.sweep.alone:
        yield ""
        yield from _alone(alone)
    yield ""
    yield from _front(study)
    yield ""
    yield from _recommended(study)


def percent(value: float | None) -> str:
    """Two digits, three from 100 % on."""
    if value is None:
        return "-"
    return f"{100 * value:.{3 if abs(value) >= 1 else 2}g} %"


def by_band(errors: Mapping[str, float]) -> str:
    """Errors of bands, or of a map's planes, in a line."""
    return ", ".join(f"{name} {percent(error)}" for name, error in errors.items())


def fragment(setting: Mapping[str, str], heading: str) -> str:
    """YAML of the setting: parameters under the step they belong to, to be merged into the file's
    steps by hand.

    A comment line holds the same for the command line.
    """
    steps: dict[str, list[str]] = {}
    top = []
    for key, value in setting.items():
        step, dot, parameter = key.rpartition(".")
        if dot:
            text = repr(value) if set(value) & set(",[]{}#:") else value
            steps.setdefault(step, []).append(f"{parameter}: {text}")
        else:
            top.append(f"{key}: {value}")
    rows = [f"# {line}" for line in (heading, f"on the command line: {arguments(setting)}")]
    rows += [*top, "operators:"] if steps else top
    for step, parameters in steps.items():
        name, _, number = step.rpartition(".")
        name, which = (name, f"  # the {number}. of that name") if number.isdigit() else (step, "")
        rows.append(f"  - {name}: {{{', '.join(parameters)}}}{which}")
    return "\n".join(rows) + "\n"


def arguments(setting: Mapping[str, str]) -> str:
    """``--set`` arguments for a shell."""
    return " ".join(f"--set {shlex.quote(text)}" for text in overrides(setting))


def _heading(study: Study) -> Iterator[str]:
    setup = study.setup
    reference = study.points[0]
    found = study.sweep
    yield f"error of {setup.metric}: {study.says}"
    if setup.shorter:
        shorter = ", ".join(f"{k} = {v}" for k, v in setup.shorter.items())
        yield (
            f"shortened scans: {shorter}. Per-scan costs weigh more, slow modes and coverage less"
            " than in whole scans."
        )
    several = setup.repeats > 1
    runs = f"medians of {setup.repeats} runs" if several else "of one run"
    spread = "half their range" if several else "half the range of the reference's runs"
    yield (
        f"CPU seconds are {runs} on {setup.threads} thread{'s' if setup.threads > 1 else ''}, ±"
        f" {spread}, in proportion to the reference's run before it; {study.runs} runs in all;"
    )
    yield "steps that act at the end (pictures, reports, files) are left out."
    yield (
        f"reference, all knobs at their tightest: {_cost(reference)} CPU s,"
        f" {reference.memory / 1e6:.0f} MB ({study.first:.1f} s the first time, with imports and"
        f" caches); its own error by its last steps: {percent(found.left)}"
    )
    if staying := found.staying:
        parts = ", ".join(f"{a.knob.key}={a.knob.present} {percent(a.stays)}" for a in staying)
        yield (
            f"  of it {percent(found.left - found.left_of_turned)} of knobs that stay as in the"
            f" file: {parts}"
        )
    floor = "none" if study.floor is None else percent(study.floor)
    yield (
        f"instrument noise in units of the error: {floor}; realization scatter:"
        f" {percent(study.scatter)}"
    )


def _alone(alone: Alone) -> Iterator[str]:
    knob = alone.knob
    last = alone.rungs[-1]
    rows = []
    yield f"{knob.key}: {knob.approximates}"
    if alone.inert:
        yield "  changes nothing here: the coarsest value gives the same bits as the tightest"
        return
    for rung in alone.rungs:
        mark = "<- file" if rung.value == knob.present else ""
        if rung.error is None:
            rows.append((rung.value, "-", "", "", "", f"{rung.note}  {mark}"))
            continue
        resolution = f" ± {percent(rung.resolution)}" if rung.resolution else ""
        spread = math.hypot(last.own_spread, rung.own_spread)
        saved = "" if rung is last else f"{last.own - rung.own:+.3f} ± {spread:.3f}"
        figures = (_cost(rung), saved, f"{rung.memory / 1e6:.0f} MB")
        rows.append((rung.value, percent(rung.error) + resolution, *figures, mark))
    head = ("value", "error", "CPU s", "saved in its step", "memory")
    yield from aligned(rows, head, ">>>>><", indent="  ")
    yield f"  what is left at {knob.tightest}: {percent(alone.left)} ({alone.how})"
    if knob.redraws:
        yield (
            "  draws other random numbers: change of the mean over seeds ± its standard error;"
            " stays as in the file below"
        )


def _front(study: Study) -> Iterator[str]:
    named = {"tightest": study.points[0], "file": study.present, "chosen": study.chosen}

    def row(point: Point) -> tuple[str, ...]:
        text = " ".join(overrides(differences(point.setting, study.sweep.reference)))
        text = text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
        marks = [name for name, p in named.items() if p and p.setting == point.setting]
        mark = f"<- {', '.join(marks)}" if marks else ""
        memory = f"{point.memory / 1e6:.0f} MB"
        return percent(point.error), _cost(point), memory, f"{text}  {mark}".strip()

    front = study.front
    yield f"Pareto front ({len(study.points)} joint settings measured)"
    rows = [row(p) for p in (front if study.present in front else [*front, study.present])]
    head = ("error", "CPU s", "memory", "what differs from the tightest")
    yield from aligned(rows, head, ">>><", indent="  ")
    if study.present.bands:
        yield "error of each band, of which the largest counts"
        rows = [(name, by_band(p.bands)) for name, p in named.items() if p and name != "tightest"]
        yield from aligned(rows, align="><", indent="  ")


def _recommended(study: Study) -> Iterator[str]:
    target = study.setup.target
    left = study.sweep.left
    chosen = study.chosen
    if chosen is None:
        yield from not_met(study)
        return
    reference = study.points[0]
    best = least(study.points, target, left)
    error = f"{percent(chosen.error)} (+ {percent(left)} of the reference), {_cost(chosen)} CPU s"
    if best is None or chosen.seconds <= best.seconds:
        ratio = reference.seconds / chosen.seconds if chosen.seconds else math.nan
        than = (
            "; it is the tightest"
            if chosen.setting == reference.setting
            else f", {ratio:.2g} times cheaper than the tightest"
        )
        yield f"cheapest setting within {percent(target)}: {error}{than}"
    else:
        yield (
            f"setting within {percent(target)}: {error}, the most accurate of those that cost as"
            " much as the"
        )
        yield f"  cheapest within its spread; that is {percent(best.error)}, {_cost(best)} CPU s"
    yield f"  {arguments(chosen.setting)}"


def not_met(study: Study) -> Iterator[str]:
    """Why no setting is shown to meet the target, what the reference's own error comes from most,
    and what to do about it.
    """
    setup = study.setup
    left = study.sweep.left
    yield (
        f"no setting is shown to meet {percent(setup.target)}: the reference is not known to better"
        f" than {percent(left)}"
    )
    worst = max(study.sweep.alone, key=lambda a: a.stays if a.knob.redraws else a.left)
    key = worst.knob.key
    seeds = len(setup.seeds)
    cures = []
    unmeasured = [a.knob.key for a in study.sweep.alone if a.unmeasured]
    cause = f"{key}, {percent(worst.stays)}"
    if unmeasured:
        cause = f"not measured within {setup.budget:g} runs: {', '.join(unmeasured)}"
        cures.append("more --budget")
    elif not worst.knob.redraws:
        cause = f"{key}, {percent(worst.left)}: {worst.how}"
    elif any(r.resolution and (r.error or 0.0) <= 2 * r.resolution for r in worst.rungs):
        cause += f": twice the standard error of means over {seeds} seeds"
        more = math.ceil(seeds * (left / setup.target) ** 2)
        cures.append(f"--seeds {more}" if left < 10 * setup.target else "more --seeds")
    else:
        cause += f": it stays at {worst.knob.present}, as in the file"
        cures.append(f"--set {key}={worst.knob.tightest}")
    yield f"  cause: {cause}"
    if setup.shorter:
        cures.append("longer scans (--duration)")
    if 0 < left < math.inf:
        digit = 10.0 ** math.floor(math.log10(left))
        cures.append(f"--target '{100 * digit * (math.floor(left / digit) + 1):.3g} %'")
    yield f"  cure: {', or '.join(cures)}"


def _cost(measured: Any) -> str:
    return f"{measured.seconds:.3g} ± {measured.spread:.2g}"


def draw(study: Study) -> Any:
    """Each knob alone, the Pareto front, the file's own and the chosen setting, floor and scatter;
    returns the figure.

    A setting that gives the reference's bits has no place on a logarithmic axis: it stands on the
    lower edge, hollow.
    """
    from matplotlib.ticker import LogLocator

    ax = new_axes((7.6, 5.4))
    setup = study.setup
    chosen = study.chosen
    front = study.front
    alone = [a for a in study.sweep.alone if not a.knob.redraws]
    errors = [p.error for p in study.points] + [r.error or 0.0 for a in alone for r in a.rungs]
    bottom = min([e for e in errors if e > 0] + [setup.target]) / 4

    def line(measured: Any, label: str, color: str, **style: Any) -> None:
        x, y = [m.seconds for m in measured], [max(m.error, bottom) for m in measured]
        bars = [m.spread for m in measured]
        ax.errorbar(x, y, xerr=bars, color=color, label=label, elinewidth=0.7, **style)

    for number, knob in enumerate(a for a in alone if not a.inert):
        rungs = [r for r in knob.rungs if r.error is not None]
        colour = SEQUENCE[number % 7]
        marker = "osD^vPX"[number % 7]
        line(rungs, f"{knob.knob.key} alone", colour, marker=marker, ms=5, lw=0.9)
        same = [r.seconds for r in rungs if not r.error]
        ax.plot(same, [bottom] * len(same), marker, color=colour, ms=5, mfc="white", clip_on=False)
    line(front, "Pareto front", "black", marker=".", ms=7, lw=1.8)
    marks = [
        (study.present, "s", 10, "none", "the file's setting"),
        (chosen, "*", 15, "gold", "chosen"),
    ]
    for point, marker, size, face, label in marks:
        if point:
            at = point.seconds, max(point.error, bottom)
            ax.plot(*at, marker, ms=size, mfc=face, mec="black", label=label, zorder=5)
    for value, style, label in (
        (setup.target, "--", f"target {percent(setup.target)}"),
        (study.floor, ":", "instrument noise"),
        (study.scatter, "-.", "realization scatter"),
    ):
        if value:
            ax.axhline(value, color="#666666", lw=1, ls=style, label=label)
    ax.set(xscale="log", yscale="log", ylabel=f"error of {setup.metric}")
    ax.set_ylim(bottom=bottom)
    ax.set_xlabel(f"CPU seconds (median of {setup.repeats} runs, bars: half their range)")
    ax.set_title(f"{setup.pipeline}: {study.says}", fontsize=9, wrap=True)
    ax.yaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.tick_params(axis="x", which="minor", labelbottom=False)
    ax.text(0.01, 0.01, "hollow: the reference's bits", transform=ax.transAxes, fontsize=7)
    ax.grid(color="#dddddd", lw=0.6)
    ax.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return ax.figure


def save(study: Study, path: Any) -> None:
    """Draw to a file (PNG, PDF, SVG by its suffix)."""
    from ..storage.files import atomic_path

    with atomic_path(path) as temporary:
        draw(study).savefig(temporary, bbox_inches="tight")
