"""A campaign from Python: a pipeline and a scene become a pipeline file, arrays files beside the
job; then it is any campaign.

>>> import zonda
>>> zonda.campaign(pipeline, scene, output="out/nights", nights=10, realizations=2)  # doctest:
+SKIP
"""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..assembly import arguments
from ..components import SESSION
from ..configuration.input_paths import InMemory
from ..configuration.loaded import PipelineFile, Step
from ..configuration.parameters import Parameters
from ..errors import PipelineError, ZondaError
from ..experiment.engines import engine
from ..experiment.variant import FileVariant
from ..operator import Operator
from ..output import Output, may_write
from ..pipeline import Pipeline
from ..registry import instruments, operators, operators_that, sites
from ..scene import Scene
from ..storage.files import check_output_folder, product_path
from ..storage.output_folder import lock
from . import run
from .campaign_file import FILE, INPUTS, Job
from .folder import check_free
from .prepare import CampaignFile, Pruning
from .section import CampaignHeader
from .settings import Campaign

PLACE = "zonda.campaign"


@dataclass(frozen=True)
class Products:
    """Products that a campaign has written.

    Attributes
    ----------
    folder
        The campaign's output folder, as `zonda status` and `zonda resume` take it.
    sets
        For each set of co-added products: values on the axes over which nothing is co-added, and
        the folder of its files.
    log
        What was counted, chosen and approximated: rows (set, who, what, value).
    """

    folder: Path
    sets: tuple[tuple[dict[str, Any], Path], ...]
    log: tuple[tuple[str, str, str, str], ...] = field(repr=False)


def campaign(
    pipeline: Pipeline,
    scene: Scene,
    *,
    output: str | Path,
    threads: int | None = None,
    memory: int | None = None,
    prune: bool = False,
    **axes: Any,
) -> Products:
    """Run a pipeline over many observations as tasks, on one machine or many, and combine their
    maps.

    Arrays that steps hold are written to ``output/inputs``, the whole as ``output/resolved.yaml``.
    From then on it is the campaign of that file: the same bits, and `zonda status` and `zonda
    resume` work on the folder.

    Parameters
    ----------
    pipeline, scene
        What is done, by installed operators; what exists.
    output
        Folder for products. The pipeline needs a step that writes them.
    threads, memory
        Threads of each task; bytes of the whole campaign on this machine. Default: all, and half of
        the free memory.
    prune
        Leave out what the products do not depend on, and what the errors allow, as `zonda run`
        does; default: all is simulated.
    axes
        The keys of ``campaign:`` in a pipeline file: ``grid``, ``observations``, ``nights``,
        ``realizations``, ``combine``, ``engine``, ``workers`` ... Values may be astropy's
        quantities and times.

    Raises
    ------
    PipelineError
        For a step that workers cannot know: a function, a class that is not installed; and where
        nothing is written.
    ConfigurationError
        For axes that the pipeline does not have.
    OutputError
        Where the folder holds an unfinished campaign, or cannot be written.
    ZondaError
        At the end where tasks have failed.
    """
    threads, memory, _ = arguments.check_run(
        scene,
        output,
        {"threads": threads, "memory": memory, "ceiling": None},
        (),
        PLACE,
    )
    keys = _keys(pipeline)
    settings = Campaign(**{key: _plain(value, key) for key, value in axes.items()})
    folder = Path(output)
    options = {"workers": settings.workers, "scheduler": settings.scheduler, "tls": settings.tls}
    with engine(
        settings.engine,
        **options,  # type: ignore[arg-type]
        threads=threads,
        memory=memory,
    ) as pool:
        if pool.executor is None:  # a worker of MPI
            return Products(folder, (), ())
        check_output_folder(folder)
        with lock(folder), _inputs(folder) as inputs:
            source = _source(pipeline, scene, keys, settings, (inputs, folder))
            call = (
                f"{PLACE}({pipeline.name},"
                f" {', '.join(f'{key}={value!r}' for key, value in axes.items())})"
            )
            result = run.begin([source], folder, call, pool, _say, Pruning(prune_all=prune))
    sets = tuple((dict(c.axes), folder / c.folder) for c in Job.read(folder).combinations)
    return Products(folder, sets, tuple(row[:4] for row in result.log))


def _keys(pipeline: Any) -> list[str]:
    """The names of the steps' classes. Raises `PipelineError` for a pipeline that cannot be a
    campaign.
    """
    if not isinstance(pipeline, Pipeline):
        cure = (
            "write zonda.campaign(zonda.Pipeline([...]), scene, output=...); a pipeline file:"
            " zonda.load(file).pipeline()"
        )
        raise PipelineError(
            f"a campaign is made of a Pipeline, not of {pipeline!r:.60}",
            place=PLACE,
            cure=cure,
        )
    keys = []
    for operator in pipeline.operators:
        if (key := _registered(type(operator))) is None:
            raise PipelineError(
                f"{operator.label} is a function or a class of this session, which the campaign's"
                " workers do not know",
                place=PLACE,
                cure=(
                    "make it a plugin (zonda new plugin NAME, pip install -e NAME), or run(scene)"
                    " once for each observation"
                ),
            )
        keys.append(key)
    if not any(map(may_write, pipeline.operators)):
        writers = ", ".join(operators_that(lambda step: issubclass(step, Output)))
        raise PipelineError(
            "no step writes anything",
            place=PLACE,
            cure=f"add one that does: {writers}",
        )
    return keys


def _registered(kind: type[Operator]) -> str | None:
    """The name by which workers know a class; None where they do not."""
    reference = f"{kind.__module__}:{kind.__qualname__}"
    for found in operators.candidates():
        named = found.name == kind.__name__ or found.reference == reference
        if named and found.distribution != SESSION and operators.get(found.qualified) is kind:
            return found.name
    return None


@contextlib.contextmanager
def _inputs(folder: Path) -> Iterator[Path]:
    """Folder for arrays; removed again where the campaign does not begin. Raises `OutputError` in
    an unfinished campaign.
    """
    check_free(folder)
    try:
        yield folder.resolve() / INPUTS
    except BaseException:
        if not (folder / FILE).exists():
            shutil.rmtree(folder / INPUTS, ignore_errors=True)
        raise


def _source(
    pipeline: Pipeline,
    scene: Scene,
    keys: list[str],
    settings: Campaign,
    folders: tuple[Path, Path],
) -> CampaignFile:
    """The pipeline file that says the same. ``folders``: of arrays, and of products.

    Raises `PipelineError` for what no file can say.
    """
    steps = list(pipeline.operators)
    for number, step in enumerate(pipeline.operators):
        if isinstance(step, InMemory):
            steps[number] = step.in_files(product_path(folders[0], step.label, ".fits"))
            steps[number]._label = step.label
    header = CampaignHeader(
        name=pipeline.name,
        description=pipeline.description,
        runs={
            name: signal for name, signal in pipeline.runs.items() if not name.startswith("_")
        },  # others: outputs ask again
        only=list(pipeline.only),
        precision=pipeline.precision,
        campaign=settings,
        outputs=folders[1],
    )
    named = {"site": _named(scene.site, sites), "instrument": _named(scene.instrument, instruments)}
    text = PipelineFile(header, named, tuple(map(Step, keys, steps)), PLACE, scene).resolved_yaml()
    variant = FileVariant(PLACE, text=text)
    file = variant.file
    pairs = [
        ("the scene", scene, file.scene()),
        *((s.label, s, o) for s, o in zip(steps, file.operators, strict=True)),
    ]
    for label, ours, read in pairs:
        if type(read) is not type(ours) or read.model_dump(mode="json") != ours.model_dump(
            mode="json"
        ):
            cure = "use what files can say: registered names, numbers, text, files"
            raise PipelineError(
                f"{label} cannot be written in a pipeline file",
                place=PLACE,
                cure=cure,
            )
    return CampaignFile(variant)


def _named(component: Any, names: Any) -> Any:
    """The registered name of a site or an instrument; its parameters where it has none."""
    with contextlib.suppress(ZondaError):
        if component.name in names and names.create(component.name) == component:
            return component.name
    return component.model_dump(mode="json")


def _plain(value: Any, place: str) -> Any:
    """A value of an axis as a pipeline file writes it: astropy's quantities and times, numpy's
    numbers, zonda's objects.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(inner, f"{place}.{key}") for key, inner in value.items()}
    if isinstance(value, Parameters):
        return value.model_dump(mode="json", include=value.model_fields_set)
    if hasattr(value, "unit") and hasattr(value, "value"):  # an astropy Quantity
        numbers = np.asarray(value.value)
        texts = [f"{n!r}".removesuffix(".0") + f" {value.unit}" for n in np.ravel(numbers).tolist()]
        return texts if np.ndim(numbers) else texts[0]
    if hasattr(value, "utc") and hasattr(value, "isot"):  # an astropy Time
        return np.asarray(value.utc.isot).tolist()
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), place)
    if isinstance(value, list | tuple | range):
        return [_plain(inner, place) for inner in value]
    if isinstance(value, Path):
        return str(value)
    cure = "give a number, text such as '0.3 deg/s', a quantity or a time"
    raise PipelineError(
        f"{place}: {value!r:.60} cannot be written in a pipeline file",
        place=PLACE,
        cure=cure,
    )


def _say(text: str) -> None:
    print(text, file=sys.stderr)
