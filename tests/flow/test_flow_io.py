"""Files of flows: the round trip is exact, and nothing but a whole, sound file is accepted."""

import math
import struct

import pytest
import torch
from conftest import record, tampered

from sympflow.flow.files import load
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.mlp import MLPFlow
from sympflow.flow.potentials import MLPPotential
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.domain import Box
from sympflow.systems import henon_heiles

MAKERS = {
    "sympflow": lambda: SympFlow(2, pairs=2, hidden=(5, 4), activation="sin", dt=0.5, seed=3),
    "scaled": lambda: SympFlow(2, hidden=(4,), scale=Scaling((0.1, 2.0), (3.0, 4.0), 0.1, (0.5, 0.0))),
    "mixed layers": lambda: SympFlow.from_layers(
        [Drift(MLPPotential(2, (3,))), Kick(MLPPotential(2, (4, 5), "softplus")), Kick(MLPPotential(2))], dt=2.0
    ),
    "float32": lambda: SympFlow(2, dtype=torch.float32),
    "mlp": lambda: MLPFlow(2, (5, 6, 7), activation="logcosh", dt=0.5),
}


@pytest.fixture
def file(tmp_path):
    """A sound file, and its tensors and record to tamper with."""
    flow, path = MAKERS["sympflow"](), tmp_path / "flow.safetensors"
    flow.domain, flow.fingerprint, flow.system_name = henon_heiles().domain, henon_heiles().fingerprint, "henon_heiles"
    flow.save(path)
    return path


def test_weights_that_are_not_finite_are_neither_saved_nor_loaded(file):
    flow = load(file)
    flow.layers[0].potential.biases[0][0] = math.nan
    with pytest.raises(ValueError, match="`flow` has weights that are not finite"):
        flow.save(file)
    load(file)  # the failed save left the old file whole

    def poison(tensors):
        tensors["layers.0.potential.weight_out"][0] = math.inf

    with pytest.raises(ValueError, match=r"`path` .*weight_out is not finite"):
        load(tampered(file, change_tensors=poison))


def remove(key):
    return lambda record: record.pop(key)


def change(*keys, value):
    def apply(record):
        for key in keys[:-1]:
            record = record[key]
        record[keys[-1]] = value

    return apply


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (change("format", value=99), "format 99 is later"),
        (change("format", value="1"), "no format number"),
        (change("format", value=0), "format 0 is unknown"),
        (change("format", value=-1), "format -1 is unknown"),
        (change("kind", value="pickle"), "kind 'pickle' is unknown"),
        (change("dt", value=-1.0), "dt -1.0"),
        (change("dt", value="1"), "dt '1'"),
        (change("dt", value=math.nan), "not valid JSON"),
        (change("dt", value=1e-300), "dt 1e-300 is not a number between"),
        (change("dt", value=1e300), "dt 1e\\+300 is not a number between"),
        (change("architecture", value=None), "architecture is missing"),
        (change("architecture", "ndof", value=10**12), "ndof 1000000000000"),
        (change("architecture", "ndof", value=True), "ndof True"),
        (change("architecture", "ndof", value=3), "has shape"),
        (change("architecture", "layers", value=[]), "list of layers"),
        (change("architecture", "layers", value=[{}] * 10**4), "list of layers"),
        (change("architecture", "layers", 0, value="kick"), "layer of unknown kind"),
        (change("architecture", "layers", 0, "kind", value="__import__"), "layer of unknown kind"),
        (change("architecture", "layers", 0, "potential", "type", value="x"), "it needs the potential 'x'"),
        (change("architecture", "layers", 0, "potential", "type", value=3), "potential of unknown type"),
        (change("architecture", "layers", 0, "potential", "activation", value="relu"), "the activation 'relu'"),
        (change("architecture", "layers", 0, "potential", "hidden", value=[10**9]), "hidden width"),
        (change("architecture", "layers", 0, "potential", "hidden", value=[4096] * 900), "too large"),
        (change("architecture", "layers", 0, "potential", "hidden", value=[]), "hidden layers"),
        (change("architecture", "layers", 0, "potential", "hidden", value=[5]), "do not fit"),
        (change("domain", value={"kind": "Klein bottle"}), "domain"),
        (change("domain", value=[1]), "domain"),
        (change("domain", value={"kind": "Ball", "center": [0.0, 0.0], "radius": 1.0}), "states of length 2, not 4"),
        (change("domain", value={"kind": "Ball", "center": ["0"] * 4, "radius": 1.0}), "not made of numbers"),
        (change("domain", "energy", value="0.1"), "energy '0.1' is not made of numbers"),
        (change("domain", "box", "kind", value="Ball"), "domain is not admissible"),
        (change("domain", "box", "kind", value="Torus"), "unknown kind of domain: 'Torus'"),
        (change("domain", "box", "colour", value=1), "domain is not admissible"),
        (change("dt", value=10**400), "is not a number between"),
        (change("fingerprint", value=[10**400] * 8), "too large"),
        (change("architecture", "layers", 0, "kind", value=["kick"]), "layer of unknown kind"),
        (change("fingerprint", value=["a"] * 8), "fingerprint is not a list of numbers"),
        (change("fingerprint", value=[0.1] * 7), "fingerprint is not a list of 8 numbers"),
        (change("fingerprint", value=None), "fingerprint of the system 'henon_heiles' is missing"),
        (remove("fingerprint"), "record has no fingerprint"),
        (remove("system"), "record has no system"),
        (remove("domain"), "record has no domain"),
        (remove("figures"), "record has no figures"),
        (remove("checksum"), "no checksum"),
        (change("version", value=1), "version is not a string"),
        (change("figures", value={"energy_error_max": "x"}), "energy_error_max that is neither a number nor None: 'x'"),
        (change("figures", value={"error_1": [1.0]}), "error_1 that is neither"),
        (change("figures", value={"error_1": True}), "error_1 that is neither"),
        (change("recipe", value={"stages": 3}), "stages that are not a list"),
        (change("recipe", value={"stages": [{"steps": "many"}]}), "steps 'many'"),
        (change("recipe", value={"stages": [{"optimizer": None}]}), "optimizer None"),
        (change("recipe", value={"stages": [{"points": [1]}]}), r"points \[1\]"),
        (change("recipe", value={"torch": 2}), "torch that is not a string"),
        (change("recipe", value={"scaling": {"q": [1.0]}}), "scaling"),
        (change("recipe", value={"scaling": Scaling.unit(1).to_dict()}), "not of 2 degrees of freedom"),
        (change("recipe", value={"scaling": {**Scaling.unit(2).to_dict(), "t": "1"}}), "scaling"),
        (change("recipe", value=None), "recipe"),
        (change("figures", value=3), "figures"),
        (change("system", value=3), "system is not a name"),
    ],
)
def test_a_false_record_is_refused(file, edit, message):
    with pytest.raises(ValueError, match=message):
        load(tampered(file, change_record=edit))


def turned(record):
    record["architecture"]["layers"].reverse()


@pytest.mark.parametrize(
    "edit",
    [
        change("dt", value=0.7),
        change("architecture", "layers", 0, "potential", "activation", value="tanh"),
        change("system", value="pendulum"),
        change("figures", value={"one_step_error": 1e-12}),
        change("domain", value=Box([-1.0] * 4, [1.0] * 4).to_dict()),
        change("recipe", value={"seed": 1}),
        turned,
    ],
)
def test_an_altered_record_is_refused(file, edit):
    """Entries that are admissible, but not those that were saved; files of format 1 could not tell, and still load."""
    load(tampered(file))
    with pytest.raises(ValueError, match=r"`path` .* its record is not the one that was saved: its checksum differs"):
        load(tampered(file, change_record=edit, altered=True))
    load(tampered(file, change_record=change("format", value=1), altered=True))


def rename(tensors):
    tensors["layers.0.potential.extra"] = tensors.pop("layers.0.potential.weight_t")


def reshape(tensors):
    tensors["layers.0.potential.weight_x"] = tensors["layers.0.potential.weight_x"].T.contiguous()


def retype(tensors):
    tensors["layers.0.potential.weight_x"] = tensors["layers.0.potential.weight_x"].to(torch.int64)


def collapse(tensors):
    tensors["layers.0.potential.scale"].zero_()


@pytest.mark.parametrize(
    ("edit", "message"),
    [(rename, "do not fit"), (reshape, "has shape"), (retype, "F32 or all F64"), (collapse, "scale is not positive")],
)
def test_false_tensors_are_refused(file, edit, message):
    with pytest.raises(ValueError, match=message):
        load(tampered(file, change_tensors=edit))


@pytest.mark.parametrize("place", [0.1, 0.5, 0.999])
def test_one_flipped_bit_of_the_weights_is_refused(file, place):
    content = bytearray(file.read_bytes())
    begin = 8 + struct.unpack("<Q", content[:8])[0]
    content[begin + int(place * (len(content) - begin)) // 8 * 8] ^= 1  # the lowest bit of a number: it stays finite
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"`path` .* not those that were saved: their checksum differs"):
        load(file)


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS.keys())
def test_round_trip(make, tmp_path):
    flow, path = make(), tmp_path / "flow.safetensors"
    flow.domain = Box([-1.0] * 4, [1.0] * 4)
    flow.recipe, flow.figures = {"stages": [{"steps": 3}]}, {"one_step_error": 1e-3, "energy_error": math.inf}
    flow.save(path)
    same = load(path)
    x = torch.randn(5, 4, dtype=flow.dtype)
    assert torch.equal(same(1.3, x), flow(1.3, x))
    assert same.dtype == flow.dtype
    assert (same.domain, same.recipe) == (flow.domain, flow.recipe)
    assert same.figures == {"one_step_error": 1e-3, "energy_error": None}
    assert not any(w.requires_grad for w in same.parameters())
    assert record(path)["version"]


def test_tensors_that_changed_places_are_refused(file):
    def swap(tensors):
        a, b = (f"layers.{i}.potential.weight_out" for i in (0, 1))
        tensors[a], tensors[b] = tensors[b], tensors[a]

    with pytest.raises(ValueError, match="checksum differs"):
        load(tampered(file, change_tensors=swap, rechecked=False))
