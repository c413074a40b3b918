from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zonda.core import registry
from zonda.core.configuration import locate
from zonda.core.configuration.diagnostics import ConfigurationError, Diagnostic
from zonda.core.configuration.pipeline_file import PipelineFile, load, parse
from zonda.core.configuration.yaml_places import Source, Span
from zonda.core.errors import InputError, ZondaError
from zonda.core.operator import Operator


def mistakes(text: str, *overrides: str, **options: Any) -> list[Diagnostic]:
    with pytest.raises(ConfigurationError) as caught:
        parse(text, name="t.yaml", overrides=overrides, **options)
    assert isinstance(caught.value, ZondaError)
    return caught.value.diagnostics


def test_a_good_file(toys: Any) -> None:
    file = parse(toys.head + toys.steps, name="cluster.yaml")
    assert [s.key for s in file.steps] == ["ToyPointing", "ToySky", "ToyNoise", "ToySum", "ToyMap"]
    scene = file.scene()
    assert (scene.seed, scene.site.name, scene.instrument.name, scene.instrument.band.name) == (
        3,
        "toy_site",
        "toy_camera",
        "toy_band",
    )
    assert scene.target is not None
    assert file.output == Path("out/cluster")
    assert file.pipeline().name == "cluster"
    assert file.pipeline().precision == "float32"


def test_header(toys: Any) -> None:
    text = (
        "name: a b\ndescription: D\noutputs: here\nprecision: float64\nruns: {free: {without:"
        " [sky]}}\nversion: 1\n"
    )
    file = parse(text + toys.head + toys.steps)
    pipeline = file.pipeline()
    assert (pipeline.name, pipeline.description, pipeline.precision, file.output) == (
        "a b",
        "D",
        "float64",
        Path("here"),
    )
    assert list(pipeline.runs) == ["free"]
    assert file.runs["free"].without == ["sky"]


def assert_same(a: PipelineFile, b: PipelineFile) -> None:
    assert a.operators == b.operators
    assert a.scene().model_dump() == b.scene().model_dump()
    assert a.header == b.header
    assert a.output == b.output


def test_resolved_yaml_loads_to_the_same_thing(toys: Any, tmp_path: Path) -> None:
    (tmp_path / "map.fits").write_text("x")
    text = (
        toys.head
        + toys.steps.replace("- ToySky", "- ToySky: {file: map.fits}")
        + "runs: {noiseless: {only: [sky]}}\n"
    )
    file = parse(text, name="cluster.yaml", folder=tmp_path)
    resolved = file.resolved_yaml()
    for line in (
        "radius: 4 arcmin",
        "speed: 51 arcsec/s",
        "duration: 45 min",
        "method: auto",
        "scans: 1",
    ):
        assert f"\n      {line}\n" in resolved
    assert "latitude: 38 deg" in resolved  # what the site's name stood for
    again = parse(resolved, name="other.yaml")
    assert_same(file, again)
    assert again.resolved_yaml() == resolved


def test_resolved_yaml_leaves_out_defaults_that_do_not_apply(toys: Any) -> None:
    from pydantic import model_validator

    @registry.operators.register
    class ToyGrid(Operator):
        requires = frozenset({"boresight"})
        width: int = 3
        nside: int | None = None
        ordering: str = "ring"

        @model_validator(mode="after")
        def _fits(self) -> ToyGrid:
            if self.nside is None and "ordering" in self.model_fields_set:
                raise ValueError("ordering belongs to nside")
            return self

        def exec(self, block: Any, state: Any) -> None:
            """Reads nothing."""

    text = (
        toys.head + "operators: [ToyPointing: {duration: 1 s}, ToyGrid: , ToyGrid: {nside: 64}]\n"
    )
    file = parse(text)
    resolved = file.resolved_yaml()
    assert (
        "- ToyGrid:\n      width: 3\n  - ToyGrid:\n      width: 3\n      nside: 64\n      ordering:"
        " ring\n" in resolved
    )
    assert_same(file, parse(resolved))


def test_inline_site_and_instrument(toys: Any) -> None:
    head = (
        "site: {name: mine, latitude: 38 deg, longitude: -79 deg, altitude: 800 m}\ninstrument:"
        " {name: i, telescope: {name: t, diameter: 10 m}, band: toy_band, detectors: 3,"
        " field_of_view: 1 arcmin,\n  main_beam_efficiency: 30 %, illumination_efficiency: 0.8,"
        " net: 1 mK s(1/2), sample_rate: 50 Hz}\ntime: 2024-11-25T07:00\n"
    )
    file = parse(head + toys.steps)
    assert file.scene().site.latitude == pytest.approx(np.radians(38))
    assert file.scene().instrument.detectors == 3
    assert_same(file, parse(file.resolved_yaml()))


def test_anchors_live_under_x(toys: Any) -> None:
    text = (
        toys.head + "x-common: &c {duration: 1 min}\noperators: [ToyPointing: {<<: *c, scans: 2}]\n"
    )
    (pointing,) = parse(text).operators
    assert (pointing.duration, pointing.scans) == (60.0, 2)  # type: ignore[attr-defined]


LINE = 7  # of the step in the tests below, after the head and 'operators:'


@pytest.mark.parametrize(
    ("step", "column", "length", "words"),
    [
        (
            "- ToyPointing: {duration: 51 arcsec}",
            32,
            6,
            ["'arcsec' is a unit of angle", "'20 min'", "not a time", "Length of one scan."],
        ),
        ("- ToyPointing: {duration: 20}", 29, 2, ["20 has no unit", "add a unit, e.g. 20 min"]),
        ("- ToyPointing: {duration: '20'}", 29, 4, ["20 has no unit"]),
        ("- ToyPointing: {duration: 20 mim}", 32, 3, ["unknown unit 'mim'", "did you mean 'min'?"]),
        (
            "- ToyPointing: {duration: -20 min}",
            29,
            7,
            ["ToyPointing, duration: must be greater than 0 min, got -20 min"],
        ),
        ("- ToyPointing: {duration: .inf}", 29, 4, ["inf has no unit"]),
        (
            "- ToyPointing: {duration: 1 s, sample_rate: 0 Hz}",
            47,
            4,
            ["sample_rate: must be greater than 0 Hz, got 0 Hz", "Read-out rate."],
        ),
        ("- ToyPointing: {duration: 1 s, scans: 65}", 41, 2, ["must be at most 64, got 65"]),
        ("- ToyPointing: {duration: 1 s, method: exakt}", 42, 5, ["did you mean 'exact'?"]),
        (
            "- ToyPointing: {duration: 1 s, radus: 4 arcmin}",
            34,
            5,
            [
                "unknown key 'radus' for ToyPointing",
                "did you mean 'radius'?",
                "ToyPointing takes: name, radius",
            ],
        ),
        ("- ToyPointing: {}", 5, 11, ["ToyPointing needs 'duration'", "add 'duration: 20 min'"]),
        ("- ToyPointing", 5, 11, ["ToyPointing needs 'duration'"]),
        ("- ToyPointing: [1 s]", 18, 5, ["takes a mapping of parameters, not a list"]),
        (
            "- ToyPoynting: {duration: 1 s}",
            5,
            11,
            [
                "unknown operator 'ToyPoynting'",
                "did you mean 'ToyPointing'?",
                "`zonda plugins` lists all",
            ],
        ),
        ("- ToyPointing {duration: 1 s}", 5, 21, ["a colon is missing"]),
        (
            "- ToyPointing:\n    duration: 1 s",
            5,
            8,
            ["'duration' may be indented too little", "indent this under the operator"],
        ),
        ("-", 4, 1, ["each step is one operator"]),
        (
            "- ToyPointing: {duration: 1 s, duration: 2 s}",
            34,
            8,
            ["duplicate key 'duration'", "first given on line 7"],
        ),
    ],
)
def test_a_bad_step(toys: Any, step: str, column: int, length: int, words: list[str]) -> None:
    (found,) = mistakes(f"{toys.head}operators:\n  {step}\n")
    line = LINE + step.count("\n")
    assert (found.span.line + 1, found.span.column + 1) == (line, column)
    assert found.place == f"t.yaml:{line}:{column}"
    rendered = found.render()
    assert f"{' ' * (column - 1)}{'^' * length}" in rendered
    assert "^" * (length + 1) not in rendered
    for each in words:
        assert each in rendered


@pytest.mark.parametrize(
    ("change", "line", "column", "words"),
    [
        (
            ("seed: 3", "sede: 3"),
            5,
            1,
            ["unknown key 'sede' for the pipeline", "did you mean 'seed'?"],
        ),
        (("seed: 3", "seed: -3"), 5, 7, ["must be at least 0, got -3"]),
        (("seed: 3", "seed: 3\nseed: 4"), 6, 1, ["duplicate key 'seed'", "first given on line 5"]),
        (
            ("site: toy_site", "site: toy_sight"),
            1,
            7,
            ["unknown site 'toy_sight'", "did you mean 'toy_site'?"],
        ),
        (
            ("toy_camera", "tolteq"),
            2,
            13,
            ["unknown instrument 'tolteq'", "`zonda plugins` lists all"],
        ),
        (("site: toy_site\n", ""), 1, 1, ["the pipeline needs 'site'"]),
        (("2024-11-25T07:00", "yesterday"), 3, 7, ["cannot read 'yesterday' as a time"]),
        (("05h00m00s +20d00m00s", "M 87"), 4, 9, ["cannot read 'M 87' as a position"]),
        (("seed: 3", "version: 2"), 5, 10, ["version", "1"]),
        (("seed: 3", "name: ../up"), 5, 7, ["name"]),
        (
            ("seed: 3", "precision: float16"),
            5,
            12,
            ["'float32' or 'float64'", "did you mean 'float64'?"],
        ),
        (
            ("seed: 3", "requires: [zonda>=99]"),
            5,
            12,
            ["this pipeline needs zonda>=99", "is installed"],
        ),
        (
            ("seed: 3", "requires: [not-on-this-machine>=1]"),
            5,
            12,
            ["needs the package not-on-this-machine", "not installed"],
        ),
        (
            ("seed: 3", "requires: zonda"),
            5,
            11,
            ["expected a list, got 'zonda'", "^^^^^ write [zonda]"],
        ),
        (("seed: 3", "requires: ['?']"), 5, 12, ["'?' is not a requirement"]),
        (
            ("seed: 3", "runs: {a: {only: [sqy]}}"),
            5,
            19,
            ["names 'sqy', which no step provides", "did you mean 'sky'?"],
        ),
        (
            ("seed: 3", "runs: {a: {onyl: [sky]}}"),
            5,
            12,
            ["unknown key 'onyl'", "did you mean 'only'?"],
        ),
        (
            ("seed: 3", "runs: {a: {only: [sky], without: [white]}}"),
            5,
            11,
            ["give either only or without"],
        ),
        (
            ("site: toy_site", "site: {name: s, latitude: 95 deg, longitude: 0 deg}"),
            1,
            27,
            ["latitude: must be at most 90 deg, got 95 deg"],
        ),
        (
            ("site: toy_site", "site: {name: s, latitude: 5 deg, longtude: 0 deg}"),
            1,
            34,
            ["did you mean 'longitude'?"],
        ),
    ],
)
def test_a_bad_header(
    toys: Any, change: tuple[str, str], line: int, column: int, words: list[str]
) -> None:
    found = mistakes((toys.head + toys.steps).replace(*change))
    first = [m for m in found if (m.span.line + 1, m.span.column + 1) == (line, column)]
    assert first, found
    for each in words:
        assert any(each in m.render() for m in first), (each, [m.render() for m in first])


def test_unknown_band_of_an_inline_instrument(toys: Any) -> None:
    text = toys.head.replace("toy_camera", "{name: i, band: toy_bant, detectors: 0}") + toys.steps
    found = mistakes(text)
    assert found[0].message.startswith(
        "the pipeline, instrument needs 'telescope', 'field_of_view', "
    )
    assert found[0].span.column == 0
    band = next(m for m in found if "band" in m.message)
    assert (band.message, band.label, band.span.column) == (
        "unknown band 'toy_bant'",
        "did you mean 'toy_band'?",
        28,
    )
    assert any("detectors: must be at least 1, got 0" in m.message for m in found)


@pytest.mark.parametrize(
    ("steps", "line", "words"),
    [
        (
            ["ToySky", "ToyPointing: {duration: 1 s}"],
            7,
            ["ToySky needs boresight", "move it below ToyPointing"],
        ),
        (
            ["ToyPointing: {duration: 1 s}", "ToyMap", "ToySum"],
            8,
            ["ToyMap needs signal", "move it below ToySum"],
        ),
        (
            ["ToyPointing: {duration: 1 s}", "ToySum", "ToySky"],
            8,
            ["ToySky provides sky only after ToySum has used it"],
        ),
        (
            ["ToyPointing: {duration: 1 s}", "ToyMap"],
            8,
            ["ToyMap needs signal, which no step provides"],
        ),
    ],
)
def test_misordered_operators(toys: Any, steps: list[str], line: int, words: list[str]) -> None:
    (found,) = mistakes(toys.head + "operators:\n" + "".join(f"  - {step}\n" for step in steps))
    assert (found.span.line + 1, found.span.column + 1) == (line, 5)
    for each in words:
        assert each in found.render()


def test_order_is_checked_beside_other_mistakes_but_not_behind_unknown_steps(toys: Any) -> None:
    text = (
        toys.head
        + "operators:\n  - ToySky\n  - ToyPointing: {duration: 1}\n  - Mystery\n  - ToyMap\n"
    )
    found = [(m.span.line + 1, m.message.split(",")[0]) for m in mistakes(text)]
    assert found == [
        (7, "ToySky needs boresight"),
        (8, "ToyPointing"),
        (9, "unknown operator 'Mystery'"),
    ]


def test_every_mistake_at_once(toys: Any) -> None:
    text = toys.head.replace("toy_site", "moon").replace("seed", "sede") + toys.steps.replace(
        "45 min", "45"
    ).replace("ToySky", "ToySkye")
    found = mistakes(text, "ToyMap.pixel=2 s", "nonsense")
    assert [(m.span.source.name, m.span.line + 1) for m in found] == [
        ("t.yaml", 1),
        ("t.yaml", 5),
        ("t.yaml", 7),
        ("t.yaml", 8),
        ("--set", 1),
        ("--set", 1),
    ]
    error = ConfigurationError(found, "t.yaml")
    assert str(error).endswith("6 mistakes in t.yaml and --set")
    assert "\033" not in str(error)
    assert "\033" in error.render(colour=True)


def test_errors_survive_pickling(toys: Any) -> None:
    import pickle

    error = ConfigurationError(mistakes(toys.head + "operators: [Nothing]\n"), "t.yaml")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "this pipeline file is empty"),
        ("# nothing\n", "this pipeline file is empty"),
        ("- a\n", "a mapping of keys, not a list"),
        ("hello\n", "a mapping of keys, not text"),
        ("a: [1\n", "is not closed"),
    ],
)
def test_not_a_pipeline(text: str, words: str) -> None:
    (found,) = mistakes(text)
    assert words in found.message


@pytest.mark.parametrize(
    "operators",
    ["", "operators:\n", "operators: []\n", "operators: {ToySky: }\n", "operators: ToySky\n"],
)
def test_no_steps(toys: Any, operators: str) -> None:
    (found,) = mistakes(toys.head + operators)
    assert "a list of steps" in found.message
    assert ("is empty" in found.message) == (operators in ("operators:\n", "operators: []\n"))


# --- overrides


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (
            "ToyPointing.radius=5 arcmin",
            lambda f: f.operators[0].radius == pytest.approx(np.radians(5 / 60)),
        ),
        (
            "ToyPointing.radius='5 arcmin'",
            lambda f: f.operators[0].radius == pytest.approx(np.radians(5 / 60)),
        ),
        (
            "ToyMap.pixel=3 arcsec",
            lambda f: f.operators[4].pixel == pytest.approx(np.radians(3 / 3600)),
        ),
        ("ToyNoise.1.knee=2 Hz", lambda f: f.operators[2].knee == 2.0),
        ("ToySum.name=total", lambda f: f.operators[3].name == "total"),
        ("seed=9", lambda f: f.scene().seed == 9),
        ("runs.free={without: [sky]}", lambda f: f.runs["free"].without == ["sky"]),
        ("runs.free.without=[sky]", lambda f: f.runs["free"].without == ["sky"]),
        ("outputs=a=b", lambda f: f.output == Path("a=b")),
        (
            "target=13:47:30.6 -11:45:09",
            lambda f: (
                f.scene().target.longitude
                == pytest.approx(np.radians(15 * (13 + 47 / 60 + 30.6 / 3600)))
            ),
        ),
    ],
)
def test_a_setting(toys: Any, setting: str, expected: Any) -> None:
    text = (
        toys.head + toys.steps
        if "runs.free.w" not in setting
        else toys.head + toys.steps + "runs: {free: {only: [sky]}}\n"
    )
    if "runs.free.w" in setting:
        found = mistakes(text, setting)  # both only and without
        assert "give either only or without" in found[0].message
        return
    assert expected(parse(text, overrides=[setting]))


def test_settings_by_own_name_and_number(toys: Any) -> None:
    text = toys.head + toys.steps.replace(
        "  - ToyNoise\n", "  - ToyNoise\n  - ToyNoise: {name: extra}\n"
    )
    file = parse(text, overrides=["ToyNoise.2.knee=3 Hz", "ToyNoise.1.knee=1 Hz"])
    assert [o.knee for o in file.operators[2:4]] == [1.0, 3.0]  # type: ignore[attr-defined]
    assert parse(text, overrides=["extra.knee=4 Hz"]).operators[3].knee == 4.0  # type: ignore[attr-defined]
    (found,) = mistakes(text, "ToyNoise.knee=3 Hz")
    assert "there are 2 steps 'ToyNoise'" in found.message
    assert "ToyNoise.1 or ToyNoise.2" in found.help


@pytest.mark.parametrize(
    ("setting", "column", "words"),
    [
        ("ToyNoise.knee=0.5 s", 19, "'s' is a unit of time"),
        ("ToyNoise.knee=0.5", 15, "0.5 has no unit"),
        ("ToyNoise.kne=0.5 Hz", 1, "did you mean 'knee'?"),
        ("ToyNose.knee=0.5 Hz", 1, "did you mean 'ToyNoise'?"),
        ("sed=8", 1, "did you mean 'seed'?"),
        ("seed=eight", 6, "expected a whole number, got 'eight'"),
        ("seed", 1, "needs a key, '=' and a value"),
        ("=8", 1, "needs a key, '=' and a value"),
        ("", 1, "needs a key, '=' and a value"),
        ("ToyNoise=3", 1, "is a step, not a parameter"),
        ("ToyNoise.=3", 1, "is a step, not a parameter"),
        ("ToyNoise.3.knee=1 Hz", 1, "there is no step 'ToyNoise.3'"),
        ("ToyNoise.knee.x=1 Hz", 1, "'ToyNoise.knee' is not a mapping"),
        ("site.altitude=1 km", 1, "'site' is a name, not a mapping"),
        ("operators=[]", 1, "the list of operators cannot be set"),
        ("seed=[", 7, "not valid YAML"),
        ("site=moon", 6, "unknown site 'moon'"),
    ],
)
def test_a_bad_setting_shows_its_text(toys: Any, setting: str, column: int, words: str) -> None:
    text = toys.head + toys.steps.replace("- ToyNoise", "- ToyNoise: {knee: 1 Hz}")
    found = [m for m in mistakes(text, setting) if words in m.render()]
    assert found, mistakes(text, setting)
    assert found[0].span.source == Source("--set", setting)
    assert found[0].place == f"--set:1:{column}"


# --- files


def test_input_paths(toys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    beside, here = tmp_path / "beside", tmp_path / "here"
    for folder, names in ((beside, "ab"), (here, "bc")):
        folder.mkdir()
        for name in names:
            (folder / f"{name}.fits").write_text(name)
    monkeypatch.chdir(here)
    pipeline = beside / "p.yaml"

    def sky(name: str) -> Any:
        pipeline.write_text(
            toys.head + toys.steps.replace("- ToySky", f"- ToySky: {{file: {name}}}")
        )
        return load(pipeline).operators[1].file  # type: ignore[attr-defined]

    assert sky("a.fits") == beside / "a.fits"
    assert sky("b.fits") == beside / "b.fits"  # the pipeline's own folder comes first
    assert sky("c.fits") == here / "c.fits"
    assert sky(str(here / "c.fits")) == here / "c.fits"
    with pytest.raises(ConfigurationError) as caught:
        sky("bb.fits")
    (found,) = caught.value.diagnostics
    assert found.place == f"{pipeline}:8:20"
    assert "no such file: 'bb.fits'" in found.message
    assert found.label == "did you mean 'b.fits'?"
    assert str(beside) in found.message
    assert str(here) in found.message
    with pytest.raises(
        ConfigurationError,
        match=r"a folder(.|\n)*; name a file in it: ../here/b.fits, ../here/c.fits",
    ):
        sky("../here")
    with pytest.raises(
        ConfigurationError, match=r"'\?\.fits' is a pattern(.|\n)*it stands for: a\.fits, b\.fits\n"
    ):
        sky("'?.fits'")
    with pytest.raises(
        ConfigurationError,
        match=r"'\.\./h\*/\[c\]\.fits' is a pattern(.|\n)*stands for: \.\./here/c\.fits",
    ):
        sky("'../h*/[c].fits'")
    with pytest.raises(ConfigurationError, match=r"'\*\.h5' is a pattern(.|\n)*it stands for none"):
        sky("'*.h5'")
    with pytest.raises(ConfigurationError, match=r"no such file: '\[d\]\.fits'"):
        sky("'[d].fits'")
    with pytest.raises(ConfigurationError, match="no such file: '~nobody-of-that-name/x'"):
        sky("~nobody-of-that-name/x")
    with pytest.raises(ConfigurationError, match="expected the path of a file, got 3"):
        sky("3")


def test_missing_pipeline_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cluster.yaml").write_text("a: 1")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"clustre\.yaml: no such pipeline file") as caught:
        load("clustre.yaml")
    assert caught.value.cure == "did you mean 'cluster.yaml'?"
    with pytest.raises(InputError, match="no such pipeline file"):
        load(tmp_path / "nowhere" / "x.yaml")


def test_folder_given(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text("a: 1")
    with pytest.raises(InputError, match="is a folder, not a pipeline file") as caught:
        load(tmp_path)
    assert str(tmp_path / "p.yaml") in caught.value.cure


def test_not_utf8(tmp_path: Path) -> None:
    path = tmp_path / "latin.yaml"
    path.write_bytes("a: 1\nname: h\u00e9\n".encode("latin-1"))
    with pytest.raises(InputError, match=r"latin.yaml:2:8: is not UTF-8 text \(byte 0xe9\)"):
        load(path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("m.fits", b"SIMPLE  =                    T".ljust(2880), "is a binary or data file"),
        ("m.fits.gz", b"\x1f\x8b\x08\0rest", "is a binary or data file"),
        ("tod.h5", b"\x89HDF\r\n\x1a\n\0", "data are named in a pipeline"),
        ("wide.yaml", "site: x".encode("utf-16"), "a YAML file in UTF-8"),
        ("any.bin", b"name: a\0b", "is a binary or data file"),
        ("run.py", b"import zonda\n", "is a Python script"),
    ],
)
def test_files_that_are_no_pipeline(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        load(tmp_path / name)
    assert caught.value.cure
    assert caught.value.place == str(tmp_path / name)


def test_json_is_yaml(toys: Any, tmp_path: Path) -> None:
    (tmp_path / "p.json").write_text('{"site": "toy_site", "instrument": "toy_camera"}')
    with pytest.raises(ConfigurationError, match="the pipeline needs 'operators'"):
        load(tmp_path / "p.json")


@pytest.mark.parametrize(
    ("step", "column", "words"),
    [
        ("ToyMap:{pixel: 2 arcsec}", 5, "a space is missing behind the colon"),
        ("ToyMap: {pixel:2 arcsec}", 14, "write a space after the colon: pixel: 2 arcsec"),
        ("ToyMap: pixel:2 arcsec", 13, "write a space after the colon: pixel: 2 arcsec"),
    ],
)
def test_a_space_missing_in_a_step(toys: Any, step: str, column: int, words: str) -> None:
    steps = toys.steps.splitlines(keepends=True)
    (found,) = mistakes(toys.head + "".join(steps[:-1]) + f"  - {step}\n")
    assert found.span.column + 1 == column
    assert found.label == words


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("intrument", "instrument"),
        ("operator", "operators"),
    ],
)
def test_a_key_of_another_name_is_one_mistake(toys: Any, written: str, meant: str) -> None:
    (found,) = mistakes((toys.head + toys.steps).replace(f"{meant}:", f"{written}:"))
    assert found.message == f"unknown key '{written}' for the pipeline"
    assert found.label == f"did you mean '{meant}'?"


def test_many_missing_keys_are_one_mistake(toys: Any) -> None:
    (found,) = mistakes(
        toys.head.replace("instrument: toy_camera", "instrument: {name: x, band: toy_band}")
        + toys.steps
    )
    assert "needs 'telescope', 'detectors', 'field_of_view'" in found.message
    assert "detectors: Number of detectors." in found.help


def test_a_setting_without_its_step_names_the_step(toys: Any) -> None:
    (found,) = mistakes(toys.head + toys.steps, "pixel=3 arcsec")
    assert found.label == "did you mean 'ToyMap.pixel'?"


@pytest.mark.parametrize("zone", ["+25:00", "-15:00", "+05:99"])
def test_a_time_zone_that_is_none(toys: Any, zone: str) -> None:
    head = "\n".join(
        f"time: 2024-11-25T07:00{zone}" if r.startswith("time:") else r
        for r in toys.head.splitlines()
    )
    (found,) = mistakes(head + "\n" + toys.steps)
    assert f"no time zone is {zone} from UTC; offsets go from -14:00 to +14:00" in found.message
    assert "timedelta" not in found.render()


def test_too_large(tmp_path: Path) -> None:
    path = tmp_path / "big.yaml"
    path.write_bytes(b"#" * (locate.MAXIMUM_BYTES + 1))
    with pytest.raises(InputError, match="too large for a pipeline file"):
        load(path)


def test_unreadable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "p.yaml"
    path.write_text("a: 1")

    def refuse(*arguments: Any, **options: Any) -> Any:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError, match="cannot be read: Permission denied"):
        load(path)


def test_byte_order_mark(toys: Any, tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(toys.head + toys.steps, encoding="utf-8-sig")
    assert load(path).scene().seed == 3


def test_errors_raised_by_an_operator_are_placed(toys: Any) -> None:
    from pydantic import model_validator

    @registry.operators.register
    class ToyPicky(Operator):
        requires = frozenset({"boresight"})

        @model_validator(mode="after")
        def _refuse(self) -> ToyPicky:
            raise InputError("has no unit", place="map.fits", cure="add BUNIT")

    (found,) = mistakes(toys.head + "operators:\n  - ToyPointing: {duration: 1 s}\n  - ToyPicky\n")
    assert (found.message, found.help, found.span.line) == ("map.fits: has no unit", "add BUNIT", 7)


def test_long_and_wide_lines_are_shown_around_the_caret() -> None:
    source = Source("t", "名: " + "x" * 300 + " here")
    text = Diagnostic("m", Span(source, 0, 304, 0, 308)).render()
    assert max(map(len, text.splitlines())) < 200
    assert "here" in text
    wide = Diagnostic("m", Span(Source("t", "名: ab"), 0, 3, 0, 5)).render().splitlines()
    assert wide[-1].endswith("    ^^")  # 名 takes two columns


# --- schema


def test_schema_agrees_with_the_checks(toys: Any) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    from zonda.core.configuration.schema import json_schema
    from zonda.core.configuration.yaml_places import load as read

    schema = json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    text = toys.head + toys.steps
    for good in (text, parse(text).resolved_yaml()):
        assert [e.message for e in validator.iter_errors(read(Source("t", good)).value)] == []
    for bad in (
        text.replace("45 min", "45"),
        text.replace("ToySky", "ToySkye"),
        text.replace("seed: 3", "sede: 3"),
        text.replace("site: toy_site\n", ""),
        text.replace("45 min", "45 min, radus: 1 deg"),
    ):
        assert list(validator.iter_errors(read(Source("t", bad)).value))


def test_schema_describes_every_parameter(toys: Any) -> None:
    from zonda.core.configuration.schema import json_schema

    schema = json_schema()
    pointing = schema["$defs"]["ToyPointing"]["properties"]
    assert pointing["duration"]["description"] == "Length of one scan."
    assert pointing["radius"]["x-unit"] == "rad"
    assert "toy_site" in schema["properties"]["site"]["anyOf"][0]["examples"]


def test_more_steps_than_anybody_writes_are_refused_unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 20 000 written steps not one value is built; of those that an alias multiplies no step is
    looked at.
    """
    from zonda.core.configuration import pipeline_file, steps, yaml_places

    with monkeypatch.context() as patch:
        patch.setattr(yaml_places._Reader, "build", lambda *a: pytest.fail("a value was built"))
        with pytest.raises(
            pipeline_file.ConfigurationError,
            match=r"(?s)operators has more than 1000 items.*1 \| operators:\n",
        ):
            pipeline_file.parse("operators:\n" + "  - BinMap: {pixel: 2 arcsec}\n" * 20_000)

    monkeypatch.setattr(steps, "_step", lambda *a: pytest.fail("a step was looked at"))
    many = ", ".join(["A"] * 1001)
    with pytest.raises(
        pipeline_file.ConfigurationError, match=r"(?s)a pipeline of 1001 steps.*write at most 1000"
    ):
        pipeline_file.parse(f"x-steps: &many [{many}]\noperators: *many\n")


def test_a_list_of_a_thousand_steps_is_not_too_long() -> None:
    from zonda.core.configuration import yaml_places

    def load(text: str) -> yaml_places.Document:
        return yaml_places.load(yaml_places.Source("text", text), longest={"operators": 3})

    assert not load(
        "other: [1, 2, 3, 4, 5]\noperators: [{A: [1, 2, 3, 4]}, B, {C: {a: 1, b: 2, c: 3, d: 4}}]\n"
    ).faults
    assert not load("operators: {a: 1, b: 2, c: 3, d: 4}\n").faults
    assert not load("[1, 2, 3, 4, 5]\n").faults
    assert load("operators: [{A: 1}, B, C, {D: 2}]\n").faults


def test_a_campaign_too_large_is_refused_before_a_step_is_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from zonda.core.campaign import settings
    from zonda.core.configuration import pipeline_file, steps

    monkeypatch.setattr(steps, "_step", lambda *a: pytest.fail("a step was made"))
    monkeypatch.setattr(settings, "Entry", lambda *a: pytest.fail("an entry was made"))
    axis = ", ".join(map(str, range(430)))
    text = (
        f"operators: [A, B]\ncampaign:\n  grid:\n    seed: [{axis}]\n    time: [{axis}]\n   "
        f" target: [{axis}]\n"
    )
    with pytest.raises(
        pipeline_file.ConfigurationError,
        match="a campaign of 79507000 entries; make its axes shorter",
    ):
        pipeline_file.parse(text)


def test_a_campaign_too_large_is_refused_before_its_entries_are_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from zonda.core.campaign.settings import Campaign
    from zonda.core.errors import ZondaError

    with pytest.raises(
        ZondaError, match="a campaign of 79210000 entries; make its axes shorter: at most 1000000"
    ):
        Campaign(grid={"a": list(range(8900)), "b": list(range(8900))})
