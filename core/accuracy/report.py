"""A study as lines of text and as the work-precision diagram; a setting as what to write into a
pipeline file, and what to type.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from .pareto import Point, least
from .settings import overrides
from .study import Study
from .sweep import Alone, Rung, differences


def lines(study: Study, width: int = 130) -> Iterator[str]:
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
    yield from _front(study, width)
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
    setup, reference = study.setup, study.points[0]
    yield f"error of {setup.metric}: {study.says}"
    if setup.shorter:
        shorter = ", ".join(f"{k} = {v}" for k, v in setup.shorter.items())
        yield (
            f"shortened scans: {shorter}. Per-scan costs weigh more, slow modes and coverage less"
            " than in whole scans."
        )
    threads = f"{setup.threads} thread{'s' if setup.threads > 1 else ''}"
    several = setup.repeats > 1
    runs = f"medians of {setup.repeats} runs" if several else "of one run"
    spread = "half their range" if several else "half the range of the reference's runs"
    yield (
        f"CPU seconds are {runs} on {threads}, ± {spread}, in proportion to the reference's run"
        f" before it; {study.runs} runs in all;"
    )
    yield "steps that act at the end (pictures, reports, files) are left out."
    yield (
        f"reference, all knobs at their tightest: {_cost(reference.seconds, reference.spread)} CPU"
        f" s, {_megabytes(reference.memory)} ({study.first:.1f} s the first time, with imports and"
        f" caches); its own error by its last steps: {percent(study.sweep.left)}"
    )
    if staying := study.sweep.staying:
        parts = ", ".join(f"{a.knob.key}={a.knob.present} {percent(a.stays)}" for a in staying)
        yield (
            f"  of it {percent(study.sweep.left - study.sweep.left_of_turned)} of knobs that stay"
            f" as in the file: {parts}"
        )
    floor = "none" if study.floor is None else percent(study.floor)
    yield (
        f"instrument noise in units of the error: {floor}; realization scatter:"
        f" {percent(study.scatter)}"
    )


def _alone(alone: Alone) -> Iterator[str]:
    knob = alone.knob
    yield f"{knob.key}: {knob.approximates}"
    if alone.inert:
        yield "  changes nothing here: the coarsest value gives the same bits as the tightest"
        return
    yield f"  {'value':>10}  {'error':>17}  {'CPU s':>15}  {'saved in its step':>18}  {'memory':>8}"
    last = alone.rungs[-1]
    for rung in alone.rungs:
        mark = "  <- file" if rung.value == knob.present else ""
        if rung.error is None:
            yield f"  {rung.value:>10}  {rung.note}{mark}"
            continue
        saved = (
            ""
            if rung is last
            else (
                f"{last.own - rung.own:+.3f} ±"
                f" {(last.own_spread**2 + rung.own_spread**2) ** 0.5:.3f}"
            )
        )
        yield (
            f"  {rung.value:>10}  {_error(rung):>17}  {_cost(rung.seconds, rung.spread):>15} "
            f" {saved:>18}  {_megabytes(rung.memory):>8}{mark}"
        )
    yield f"  what is left at {knob.tightest}: {percent(alone.left)} ({alone.how})"
    if knob.redraws:
        yield (
            "  draws other random numbers: change of the mean over seeds ± its standard error;"
            " stays as in the file below"
        )


def _front(study: Study, width: int) -> Iterator[str]:
    yield f"Pareto front ({len(study.points)} joint settings measured)"
    yield f"  {'error':>9}  {'CPU s':>15}  {'memory':>8}  what differs from the tightest"
    for point in study.front:
        yield f"  {_point(point)}  {_short(_pairs(point, study), width - 42)}{_marks(point, study)}"
    if study.present not in study.front:
        yield (
            f"  {_point(study.present)} "
            f" {_short(_pairs(study.present, study), width - 42)}{_marks(study.present, study)}"
        )
    if study.present.bands:
        yield "error of each band, of which the largest counts"
        for name, found in (("file", study.present), ("chosen", study.chosen)):
            if found is not None:
                yield f"  {name:>6}  {by_band(found.bands)}"


def _recommended(study: Study) -> Iterator[str]:
    target, left = study.setup.target, study.sweep.left
    if study.chosen is None:
        yield from not_met(study)
        return
    chosen, reference, best = study.chosen, study.points[0], least(study.points, target, left)
    words, cost = (
        f"{percent(chosen.error)} (+ {percent(left)} of the reference)",
        _cost(chosen.seconds, chosen.spread),
    )
    if best is None or chosen.seconds <= best.seconds:
        ratio = reference.seconds / chosen.seconds if chosen.seconds else float("nan")
        than = (
            "; it is the tightest"
            if chosen.setting == reference.setting
            else f", {ratio:.2g} times cheaper than the tightest"
        )
        yield f"cheapest setting within {percent(target)}: {words}, {cost} CPU s{than}"
    else:
        yield (
            f"setting within {percent(target)}: {words}, {cost} CPU s, the most accurate of those"
            " that cost as much as the"
        )
        yield (
            f"  cheapest within its spread; that is {percent(best.error)},"
            f" {_cost(best.seconds, best.spread)} CPU s"
        )
    yield f"  {arguments(chosen.setting)}"


def not_met(study: Study) -> Iterator[str]:
    """Why no setting is shown to meet the target, what the reference's own error comes from most,
    and what to do about it.
    """
    setup, left = study.setup, study.sweep.left
    yield (
        f"no setting is shown to meet {percent(setup.target)}: the reference is not known to better"
        f" than {percent(left)}"
    )
    worst = max(study.sweep.alone, key=lambda a: a.stays if a.knob.redraws else a.left)
    key, cures = worst.knob.key, []
    unmeasured = [a.knob.key for a in study.sweep.alone if a.unmeasured]
    if unmeasured:
        yield f"  cause: not measured within {setup.budget:g} runs: {', '.join(unmeasured)}"
        cures.append("more --budget")
    elif not worst.knob.redraws:
        yield f"  cause: {key}, {percent(worst.left)}: {worst.how}"
    elif any(r.resolution and (r.error or 0.0) <= 2 * r.resolution for r in worst.rungs):
        seeds = len(setup.seeds)
        yield (
            f"  cause: {key}, {percent(worst.stays)}: twice the standard error of means over"
            f" {seeds} seeds"
        )
        cures.append(
            f"--seeds {math.ceil(seeds * (left / setup.target) ** 2)}"
            if left < 10 * setup.target
            else "more --seeds"
        )
    else:
        yield (
            f"  cause: {key}, {percent(worst.stays)}: it stays at {worst.knob.present}, as in the"
            " file"
        )
        cures.append(f"--set {key}={worst.knob.tightest}")
    if setup.shorter:
        cures.append("longer scans (--duration)")
    if 0 < left < math.inf:
        digit = 10.0 ** math.floor(math.log10(left))
        cures.append(f"--target '{100 * digit * (math.floor(left / digit) + 1):.3g} %'")
    yield f"  cure: {', or '.join(cures)}"


def _marks(point: Point, study: Study) -> str:
    words = [
        name
        for name, p in (
            ("tightest", study.points[0]),
            ("file", study.present),
            ("chosen", study.chosen),
        )
        if p and p.setting == point.setting
    ]
    return f"  <- {', '.join(words)}" if words else ""


def _pairs(point: Point, study: Study) -> Iterable[str]:
    return [f"{k}={v}" for k, v in differences(point.setting, study.sweep.reference).items()]


def _short(pairs: Iterable[str], width: int) -> str:
    text = " ".join(pairs)
    return text if len(text) <= width else text[: width - 3] + "..."


def _point(point: Point) -> str:
    return (
        f"{percent(point.error):>9}  {_cost(point.seconds, point.spread):>15} "
        f" {_megabytes(point.memory):>8}"
    )


def _error(rung: Rung) -> str:
    if rung.error is None:
        return "-"
    return percent(rung.error) + (f" ± {percent(rung.resolution)}" if rung.resolution else "")


def _cost(seconds: float, spread: float) -> str:
    return f"{seconds:.3g} ± {spread:.2g}"


def _megabytes(memory: int) -> str:
    return f"{memory / 1e6:.0f} MB"


COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#666666")
"""Okabe & Ito 2008: told apart by colour-blind eyes."""
MARKERS = "osD^vPX"


def draw(study: Study, ax: Any = None) -> Any:
    """Each knob alone, the Pareto front, the file's own and the chosen setting, floor and scatter;
    returns the Axes.

    A setting that gives the reference's bits has no place on a logarithmic axis: it stands on the
    lower edge, hollow.
    """
    if ax is None:
        from matplotlib.figure import Figure

        ax = Figure(figsize=(7.6, 5.4), dpi=120, layout="constrained").add_subplot()
    errors = [p.error for p in study.points] + [
        r.error or 0.0 for a in study.sweep.alone if not a.knob.redraws for r in a.rungs
    ]
    smallest = min([e for e in errors if e > 0] + [study.setup.target])
    bottom = smallest / 4
    ax.set_yscale("log")
    ax.set_xscale("log")
    for number, alone in enumerate(
        a for a in study.sweep.alone if not a.knob.redraws and not a.inert
    ):
        _line(ax, alone, COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)], bottom)
    front, present, chosen = study.front, study.present, study.chosen
    x, y, spread = (
        [p.seconds for p in front],
        [max(p.error, bottom) for p in front],
        [p.spread for p in front],
    )
    ax.errorbar(
        x,
        y,
        xerr=spread,
        color="black",
        marker=".",
        ms=7,
        lw=1.8,
        elinewidth=0.8,
        label="Pareto front",
        zorder=4,
    )
    ax.plot(
        present.seconds,
        max(present.error, bottom),
        "s",
        ms=10,
        mfc="none",
        mec="black",
        label="the file's setting",
        zorder=5,
    )
    if chosen:
        ax.plot(
            chosen.seconds,
            max(chosen.error, bottom),
            "*",
            ms=15,
            color="#E69F00",
            mec="black",
            label="chosen",
            zorder=5,
        )
    ax.axhline(
        study.setup.target,
        color="black",
        lw=1,
        ls="--",
        label=f"target {100 * study.setup.target:.3g} %",
    )
    for value, style, name in (
        (study.floor, ":", "instrument noise"),
        (study.scatter, "-.", "realization scatter"),
    ):
        if value:
            ax.axhline(value, color="#666666", lw=1, ls=style, label=name)
    ax.set_ylim(bottom=bottom)
    ax.text(
        0.01,
        0.01,
        "hollow on this edge: the reference's bits",
        transform=ax.transAxes,
        fontsize=7,
        color="#666666",
    )
    _axes(ax, study)
    return ax


def save(study: Study, path: Any) -> None:
    """Draw to a file (PNG, PDF, SVG by its suffix)."""
    from ..storage.files import atomic_path

    with atomic_path(path) as temporary:
        draw(study).figure.savefig(temporary)


def _line(ax: Any, alone: Alone, colour: str, marker: str, bottom: float) -> None:
    """One knob alone, coarse to fine."""
    rungs = [r for r in alone.rungs if r.error is not None]
    errors = [max(r.error or 0.0, bottom) for r in rungs]
    seconds, spread = [r.seconds for r in rungs], [r.spread for r in rungs]
    ax.errorbar(
        seconds, errors, xerr=spread, color=colour, lw=0.9, elinewidth=0.6, alpha=0.6, zorder=2
    )
    for x, y, r in zip(seconds, errors, rungs, strict=True):
        ax.plot(
            x,
            y,
            marker,
            color=colour,
            ms=5,
            mfc=colour if r.error else "white",
            zorder=3,
            clip_on=False,
        )
    ax.plot([], [], color=colour, marker=marker, ms=5, lw=0.9, label=f"{alone.knob.key} alone")


def _axes(ax: Any, study: Study) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.set_xlabel(f"CPU seconds (median of {study.setup.repeats} runs, bars: half their range)")
    ax.set_ylabel(f"error of {study.setup.metric}")
    ax.set_title(f"{study.setup.pipeline}: {study.says}", fontsize=9, wrap=True)
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{100 * v:g} %"))
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.grid(True, which="major", color="#dddddd", lw=0.6)
    ax.legend(
        fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, markerscale=0.8
    )
