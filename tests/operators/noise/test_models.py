import numpy as np
import pytest

from zonda.core.errors import PipelineError
from zonda.core.registry import noise_models
from zonda.operators.noise.models import FixedNet, NoiseModel, noise_model
from zonda.operators.noise.white import WhiteNoise


def test_fixed(make_observation):
    observation = make_observation(n_det=3)
    np.testing.assert_allclose(FixedNet().net(observation), 1.7e-3)
    np.testing.assert_allclose(FixedNet(level="2 mK s(1/2)").net(observation), 2e-3)


def test_base_class_says_what_is_missing(make_observation):
    with pytest.raises(NotImplementedError, match="net"):
        NoiseModel().net(make_observation())


def test_by_name():
    class Mine(NoiseModel):
        factor: float = 1.0

        def net(self, observation):
            return observation.focalplane.net * self.factor

    noise_models.register(Mine, name="mine_for_test")
    noise_models.register(lambda: Mine(factor=4), name="made_for_test")
    noise_models.register(lambda: 7, name="wrong_for_test")
    assert noise_model("mine_for_test") == Mine(name="mine_for_test")
    assert noise_model({"name": "mine_for_test", "factor": 3}) == Mine(
        name="mine_for_test", factor=3
    )
    assert noise_model("made_for_test").factor == 4
    with pytest.raises(ValueError, match="is no NoiseModel"):
        noise_model("wrong_for_test")
    operator = WhiteNoise(model={"name": "mine_for_test", "factor": 3})
    again = WhiteNoise(
        **operator.model_dump(mode="json", exclude_none=True, exclude={"net", "reference"})
    )
    assert again.model == operator.model
    WhiteNoise.model_json_schema()


def test_a_model_that_gives_another_number_of_detectors_is_named(bench):
    class Short(NoiseModel):
        def net(self, observation):
            return observation.focalplane.net[:3]

    noise_models.register(Short, name="short_for_test")
    with pytest.raises(PipelineError, match=r"shape \(3,\), for 7 detectors") as caught:
        bench.run([WhiteNoise(model="short_for_test")], bench.observation(), keep=())
    assert "Short.net" in caught.value.cure
