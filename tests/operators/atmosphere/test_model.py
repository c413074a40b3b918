"""The model of an observation is built once, and belongs to the parameters that it was built
with.
"""

from __future__ import annotations

from zonda.core.plan.planning import planning_of
from zonda.operators.atmosphere import model as module
from zonda.operators.atmosphere.planning import calibrated

from .test_layers import observe, operator


def test_run_and_planning_share_one_model(monkeypatch):
    built = []
    real = module.choose_resolution
    monkeypatch.setattr(module, "choose_resolution", lambda *given: built.append(1) or real(*given))
    o, op = observe(20.0), operator(layers=2)
    planning_of(op).traits(o)
    op.configure(o)
    op.prepare(o)
    planning_of(op).in_time_order(o)
    assert built == [1]
    assert calibrated(op.model(o)) is calibrated(op.model(o))


def test_other_parameters_and_other_scans_have_models_of_their_own():
    o, other, op = observe(20.0), observe(20.0, index=1), operator(layers=2)
    first = op.model(o)
    coarse = op.model_copy(update={"tolerance": 0.1})
    assert coarse.model(o).parameters.tolerance == 0.1
    assert first.parameters.tolerance == op.tolerance
    assert op.model(o) is first
    assert op.model(other).observation is other
    assert len(op._models._made) <= module.MODELS_KEPT


def test_another_tolerance_is_another_resolution_of_the_same_model():
    model = operator(layers=2).model(observe(20.0))
    assert model.resolution() is model.resolution(model.parameters.tolerance)
    assert model.resolution(0.3).step >= model.resolution().step


def test_a_new_run_forgets_the_models_and_keeps_the_bands():
    import zonda
    from zonda.core.data import Data

    o, op = observe(20.0), operator(layers=2)
    op.model(o)
    before = op._models
    data = Data(zonda.load("mustang2_cluster").scene().model_copy(update={"time": o.start}), [o])
    op.observe(data)
    assert op._models is not before
    assert not op._models._made
    assert op._models._bands is before._bands
