"""Pictures of the weather: spectra to 1 THz, lines named where they are, nothing over anything
else.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from zonda.core import registry, weather
from zonda.core.configuration.time import Instant
from zonda.operators.atmosphere.weather.absorption import absorption_table
from zonda.operators.atmosphere.weather.climatology import pwv_by_month
from zonda.operators.atmosphere.weather.sources import profile_of
from zonda.plugins.commands.weather_plots import LINES, plot_spectrum, spread, weather_figure


@pytest.fixture(scope="module")
def site():
    return registry.sites.create("llano_de_chajnantor")


@pytest.fixture(scope="module")
def air(site):
    cls, values = weather.resolve({"pwv": "0.7 mm"})
    return profile_of(cls.model_validate(values), site, Instant.parse("2024-08-01T05:00"), 0)


@pytest.fixture(scope="module")
def bands():
    names = (
        "so_lat_93ghz",
        "so_lat_145ghz",
        "so_lat_225ghz",
        "so_lat_280ghz",
        "ccat_280ghz",
        "ccat_350ghz",
        "lmt_280ghz",
    )
    return [registry.instruments.create(name).band for name in names]


@pytest.mark.parametrize(
    ("species", "name"), [("water", "H₂O"), ("dry_air", "O₂"), ("ozone", "O₃")]
)
def test_named_lines_are_lines_of_their_species(species, name):
    """Each is within a cell (0.5 GHz) of a maximum of the species' own cross-section, high up,
    where lines are narrow: it is the largest within 1.5 GHz, and stands above what is 3 GHz away.
    O2's at 60 GHz is the middle of many lines."""
    table = absorption_table()
    frequency = table.frequency / 1e9
    values = getattr(table.cross_sections(np.array([3e3]), np.array([220.0])), species)[0]
    for line in (f for f in LINES[name] if f != 60.3):
        near, around = abs(frequency - line) < 0.51, abs(frequency - line) <= 1.5
        assert values[near].max() == values[around].max(), line
        assert values[near].max() > 1.3 * min(
            np.interp(line - 3, frequency, values), np.interp(line + 3, frequency, values)
        ), line


@pytest.mark.parametrize("which", ["brightness", "transmission"])
def test_spectra_reach_1_thz_with_any_bands(air, bands, which):
    for chosen in ([], bands[:1], bands):
        ax = Figure().add_subplot()
        plot_spectrum(ax, air, math.pi / 2, chosen, which)
        assert ax.get_xlim() == (1.0, 1000.0)
        names = {t.get_text() for t in ax.texts}
        assert {"H₂O 183", "H₂O 557", "O₂ 119", "O₃ 250"} <= names
        assert {band.name for band in chosen} <= names


def test_names_lie_over_nothing(air, site, bands):
    figure = weather_figure("Title", air, pwv_by_month(site, 2024), math.pi / 2, bands)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    for ax in figure.axes:
        boxes = [t.get_window_extent() for t in ax.texts if t.get_text()]
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2)), ax.get_ylabel()
    whole = figure.bbox
    texts = [(t, t.get_window_extent()) for ax in figure.axes for t in ax.texts]
    assert all(
        box.x0 >= 0 and box.x1 <= whole.width and box.y0 >= 0 and box.y1 <= whole.height
        for _, box in texts
    )
    _, water, emission, transmission, *_ = figure.axes
    assert water.get_legend().get_window_extent().y1 <= water.get_window_extent().y0
    assert emission.get_legend() is None
    assert transmission.get_legend() is None
    (legend,) = figure.legends
    assert not any(
        legend.get_window_extent().overlaps(ax.get_window_extent()) for ax in figure.axes
    )


def test_names_move_as_little_as_they_can():
    assert spread([10, 50, 90], 20, 0, 100) == [10, 50, 90]
    assert spread([50, 50], 20, 0, 100) == [40, 60]
    assert spread([50, 55, 60, 90], 10, 0, 100) == [45, 55, 65, 90]
    assert spread([95, 97, 99], 10, 0, 100) == [80, 90, 100]
    assert spread([1, 2], 10, 0, 100) == [0, 10]
    assert spread([], 10, 0, 100) == []
