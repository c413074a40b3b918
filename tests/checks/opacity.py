"""Opaque bands, band averages and the limits of the water."""

from __future__ import annotations

from decimal import Decimal, localcontext
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from zonda.core.checks import Family, Measured
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK
from zonda.core.pipeline import Pipeline
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.atmosphere.weather.absorption import absorption_table
from zonda.operators.atmosphere.weather.bands import BandAtmosphere
from zonda.operators.atmosphere.weather.climatology import profile
from zonda.operators.atmosphere.weather.profiles import Profile
from zonda.operators.atmosphere.weather.radiative_transfer import spectrum
from zonda.operators.atmosphere.weather.sources import Table
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.noise.white import WhiteNoise
from zonda.operators.optics.efficiency import Efficiency
from zonda.operators.pointing.base import PointingStare
from zonda.plugins.checks.scenes import SITE, START, camera, largest, run, scan, scene

from .cases import BAND, EDGES, OPAQUE, WATER
from .scenes import unrefused

checks = Family("opacity")

PWV = 7.7e-3
ZENITH, LOWEST = np.pi / 2, np.radians(5.0)


@cache
def _air(pwv: float = PWV) -> Profile:
    return profile(SITE, START, pwv)


@cache
def _band(low: float, high: float, pwv: float = PWV) -> BandAtmosphere:
    return BandAtmosphere(Band(name="band", low=f"{low} GHz", high=f"{high} GHz"), _air(pwv))


@checks.add(BAND, reference="sum of e^-tau over the spectrum", limit=1e-4)
def band_average() -> Measured:
    """relative error of the transmission at 175.25 to 194.75 GHz (whole cells) through 5 mm of
    water at the zenith
    """
    pwv = 5e-3
    layers, cells = _air(pwv).layers, absorption_table().cells(175.5e9, 194.5e9)
    parts, cell, share = layers.in_parts(layers.cross_sections(cells))
    assert len(np.unique(cell)) == cells.stop - cells.start == 39
    opacity, weight = layers.opacity(parts).sum(axis=0), share
    averaged = float(np.average(np.exp(-opacity), weights=weight))
    naive = float(np.exp(-np.average(opacity, weights=weight)))
    found = float(_band(175.25, 194.75, pwv).transmission(pwv, ZENITH))
    return abs(found / averaged - 1), f"<e^-tau> = {averaged:.3f}, e^-<tau> = {naive:.3f}"


@checks.add(OPAQUE, reference="radiative transfer without interpolation", limit=1e-4)
def saturated_line() -> Measured:
    """relative error of ln <e^-tau> at 556 to 558 GHz down to 5 deg of elevation"""
    table, worst = _band(556, 558), 0.0
    for pwv in np.array([0.3, 1.0, 2.9]) * PWV:
        for elevation in (LOWEST, 0.7, ZENITH):
            exact = table.transfer(float(pwv), [float(elevation)])[0][1]
            worst = largest(worst, float(abs(table.log_transmission(pwv, elevation) / exact - 1)))
    return worst, f"tau up to {float(table.opacity(2.9 * PWV, LOWEST)):.0f}"


@checks.add(OPAQUE, reference="finite", limit=0, unit="values")
def underflow() -> int:
    """values not finite of emission, log transmission and their differences at 556 to 558 GHz,
    where e^-tau underflows
    """
    table = _band(556, 558)
    pwv = np.linspace(0, 0.99 * table.pwv_max, 30)
    found = [f(pwv, LOWEST) for f in (table.emission, table.transmission, table.log_transmission)]
    found += [
        f(pwv, 1e-9, LOWEST) for f in (table.emission_difference, table.log_transmission_difference)
    ]
    return int(sum((~np.isfinite(f)).sum() for f in found))


@checks.add(OPAQUE, reference="40-digit decimal arithmetic", limit=1e-11)
def small_differences() -> float:
    """relative error of the change of emission and of ln <e^-tau> with the water, changes from 0.3
    down to 1e-14 of it
    """
    table, elevation, worst = _band(78, 108), 0.9, 0.0
    for which, method in ((0, table.emission_difference), (1, table.log_transmission_difference)):
        for relative in (0.3, 1e-2, -5e-3, 1e-6, 1e-10, -1e-14):
            exact = _difference(table, which, PWV, relative * PWV, elevation)
            worst = largest(worst, float(abs(method(PWV, relative * PWV, elevation) / exact - 1)))
    return worst


def _difference(
    table: BandAtmosphere, which: int, pwv: float, dpwv: float, elevation: float
) -> float:
    """The table's polynomial at pwv + dpwv less that at pwv, term by term in 40 digits."""
    coefficients = table._coefficients[which]
    y = float(table._y(np.array([elevation]))[0])
    with localcontext() as context:
        context.prec = 40
        across = _chebyshev(Decimal(y), coefficients.shape[1])
        line = [
            sum((Decimal(float(c)) * t for c, t in zip(row, across, strict=True)), Decimal(0))
            for row in coefficients
        ]

        def value(water: Decimal) -> Decimal:
            x = 2 * (1 + water / Decimal(table._scale)).ln() / Decimal(table._u_max) - 1
            return sum(
                (c * t for c, t in zip(line, _chebyshev(x, len(line)), strict=True)), Decimal(0)
            )

        return float(value(Decimal(pwv) + Decimal(dpwv)) - value(Decimal(pwv)))


def _chebyshev(x: Decimal, n: int) -> list[Decimal]:
    out = [Decimal(1), x]
    while len(out) < n:
        out.append(2 * x * out[-1] - out[-2])
    return out[:n]


@checks.add(OPAQUE, reference="flagged and counted, the rest finite", limit=0, unit="samples")
def map_of_an_opaque_band() -> Measured:
    """samples neither flagged nor finite in maps at 556 to 558 GHz and on the 183 GHz line at 5 and
    60 deg of elevation
    """
    wrong, flagged = 0, []
    for low, high, elevation in ((556, 558, 60.0), (182.5, 184, 5.1), (182.5, 184, 60.0)):
        instrument = camera(7, low=f"{low} GHz", high=f"{high} GHz")
        o = scan(samples=3000, elevation=elevation, instrument=instrument)
        steps = [
            AtmosphereLayers(pwv="7.7 mm", layers=2),
            WhiteNoise(),
            Efficiency(),
            HighpassFilter(),
            BinMap(pixel="5 arcsec"),
        ]
        data = run(list(steps), o)
        product = data.products["map"]
        dropped = data.log.get("BinMap", "samples dropped: flagged")
        flagged.append(
            f"{data.log.get('Efficiency', 'detectors flagged: band transmission below 1e-06')} of"
            " 7 detectors"
        )
        wrong += (
            int((~np.isfinite(product.signal[product.hits > 0])).sum())
            + 7 * 3000
            - dropped
            - int(product.hits.sum())
        )
    return wrong, f"flagged {', '.join(flagged)}"


@checks.add(WATER, reference="water >= 0", limit=0, unit="samples")
def positive_water() -> Measured:
    """samples of negative or unknown water, PWV rms 80 % and 100 %"""
    wrong, clipped = 0, 0
    for rms in (0.8, 1.0):
        o = scan(7, 20000, radius=0)
        data = run(
            [AtmosphereLayers(pwv="1 mm", pwv_rms=rms, wind={"speed": "200 m/s"}, outputs=["pwv"])],
            o,
            keep=("pwv",),
        )
        water = 1e-3 / np.sin(o.elevation.max()) + data.observations[0].detdata["pwv"]
        wrong += int((~(water > -1e-9)).sum())
        clipped += data.log.get("AtmosphereLayers", "values of the PWV clipped to the table")
    return wrong, f"{clipped} values clipped, as the log counts"


@checks.add(
    WATER, reference="an error that names the limit and the value", limit=0, unit="not refused"
)
def ranges() -> Measured:
    """water, elevations, bands and humidities beyond the tables"""
    table = _band(78, 108)
    return unrefused(
        [
            (
                lambda: table.emission([PWV, 30e-3], 1.0),
                "PWV of 30 mm (value 1 of 2) is outside the table",
            ),
            (lambda: table.transmission(-1e-3, 1.0), "PWV of -1 mm"),
            (lambda: table.transmission(np.nan, 1.0), "PWV of nan mm"),
            (lambda: table.emission_difference(PWV, 20e-3, 1.0), "PWV of 27.7 mm"),
            (
                lambda: table.emission(PWV, np.radians(4)),
                "elevations of 4.00 to 4.00 deg leave the limits",
            ),
            (lambda: _band(990, 1010), "990 to 1010 GHz is not inside"),
            (lambda: profile(SITE, START, 0.1), "outside the limits, 0 to 60 mm"),
            (lambda: _read_humidity(130), "the relative humidity is above 120 %"),
            (lambda: _read_humidity(-1), "the share of water vapour is not between 0 and 0.1"),
        ]
    )


def _read_humidity(percent: float) -> None:
    rows = [
        f"{h}, {1000 * np.exp(-h / 8000):.2f}, {290 - 6e-3 * h:.1f}, {percent if h == 1000 else 50}"
        for h in range(0, 11000, 1000)
    ]
    with TemporaryDirectory(prefix="zonda-check-") as folder:
        path = Path(folder) / "air.csv"
        path.write_text(
            "height [m], pressure [hPa], temperature [K], relative humidity [%]\n"
            + "\n".join(rows)
            + "\n"
        )
        Table(table=path).column(SITE, START)


@checks.add(EDGES, reference="NEP^2 summed over the cells of the spectrum", limit=0.01)
def steep_band() -> Measured:
    """relative error of a background-limited NET at 66 to 118 GHz, oxygen at both edges, one
    polarization, elevation 50 deg
    """
    low, high, efficiency = 66e9, 118e9, 0.3
    pairs = camera(2, field="0 deg", low="66 GHz", high="118 GHz").model_copy(
        update={"polarization": "pairs"}
    )
    model = {
        "name": "background_limited",
        "telescope_temperature": "13 K",
        "optical_efficiency": efficiency,
    }
    steps = [
        PointingStare(scan_duration="2 s"),
        AtmosphereLayers(pwv="5 mm", pwv_rms="0 %"),
        WhiteNoise(model=model),
        Efficiency(),
    ]
    (o,) = Pipeline(steps).run(scene(pairs, target="az 150 deg el 50 deg"), threads=1).observations
    seen = spectrum(_air(5e-3).layers, np.radians(50.0), low=low, high=high)
    edges = np.clip(np.append(seen.frequency - 0.25e9, seen.frequency[-1] + 0.25e9), low, high)
    width, nu = np.diff(edges), (edges[1:] + edges[:-1]) / 2
    load = o.focalplane.illumination_efficiency[0] * (seen.brightness + seen.cmb) + 13.0
    power = efficiency * BOLTZMANN * load
    squared = 2 * (PLANCK * nu * power * width).sum() + 2 * (power**2 * width).sum()
    expected = np.sqrt(squared / 2) / (efficiency * BOLTZMANN * width.sum())
    flat = float(np.average(load, weights=width)) * efficiency * BOLTZMANN
    mean = np.sqrt(
        (2 * PLANCK * np.average(nu, weights=width) * flat + 2 * flat**2) / 2 / width.sum()
    ) / (efficiency * BOLTZMANN)
    on_sky = o.focalplane.main_beam_efficiency * float(
        _band(66, 118, 5e-3).transmission(5e-3, np.radians(50.0))
    )
    return (
        largest(*abs(o.focalplane.net * on_sky / expected - 1)),
        f"the mean load gives {mean / expected:.3f} of it",
    )
