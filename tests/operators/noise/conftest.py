import numpy as np
import pytest

from zonda.core.data import Block, Data, Observation
from zonda.core.instrument import Band, Instrument, Telescope

NET = 1.7e-3


@pytest.fixture
def make_observation():
    """A scan of an instrument with NET 1.7 mK sqrt(s), zeta = 1 and f_s = 100 Hz unless said
    otherwise.
    """

    def make(n_det=16, n_samp=4096, rate=100.0, index=0, seed=1, zeta=1.0, **instrument):
        values = {
            "name": "test",
            "telescope": Telescope(name="t", diameter="6 m"),
            "band": Band(name="b", low="140 GHz", high="160 GHz"),
            "detectors": n_det,
            "field_of_view": "1 deg",
            "main_beam_efficiency": zeta,
            "illumination_efficiency": 1,
            "net": "1.7 mK s(1/2)",
            "knee": "1 Hz",
            "pink_minimum_frequency": "0.1 Hz",
            "sample_rate": f"{rate} Hz",
        }
        camera = Instrument(**(values | instrument))
        pointing = np.tile([0.0, 0, 0, 1], (n_samp, 1))
        times = np.arange(n_samp) / rate
        scan = f"scan{index}"
        return Observation(
            scan,
            index,
            None,
            camera,
            camera.focalplane(),
            None,
            times,
            rate,
            pointing,
            pointing,
            (0, 0),
            seed,
        )

    return make


@pytest.fixture
def simulate():
    """Run operators over an observation in blocks as the executor does; returns the streams,
    whole.
    """

    def run(observation, *operators, blocks=None, dtype=np.float32):
        for operator in operators:
            operator.observe(Data(None, [observation]))
        for operator in operators:
            operator.configure(observation)
        states = [operator.prepare(observation) for operator in operators]
        n_det, n_samp = observation.n_detectors, observation.n_samples
        streams = {}
        for detectors, samples in blocks or [(slice(0, n_det), slice(0, n_samp))]:
            block = Block(observation, detectors, samples, dtype=dtype)
            for operator, state in zip(operators, states, strict=True):
                operator.exec(block, state)
            for name, values in block.detdata.items():
                streams.setdefault(name, np.full((n_det, n_samp), np.nan, dtype))[
                    detectors, samples
                ] = values
        for operator, state in zip(operators, states, strict=True):
            operator.collect(Data(scene=None), observation, state)
        return streams

    return run
