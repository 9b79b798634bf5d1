"""Reading DAPG's weights: from arrays, from pickles as mjrl has written them, and from files made to do harm."""

import copyreg
import io
import os
import pickle
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.autograd.variable import Variable

from lerobot_uca.envs.adroit import TASKS, make_simulator
from lerobot_uca.envs.experts import dapg_pickle
from lerobot_uca.envs.experts.dapg import DAPGExpert, DAPGWeights
from lerobot_uca.errors import UserError

N_IN, N_HIDDEN, N_OUT = 39, (5, 4), 28


def random_weights() -> DAPGWeights:
    rng = np.random.default_rng(0)
    first, second = N_HIDDEN
    shapes = [(first, N_IN), (first,), (second, first), (second,), (N_OUT, second), (N_OUT,)]
    shapes += [(N_IN,), (N_IN,), (N_OUT,), (N_OUT,)]
    return DAPGWeights(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


@pytest.fixture
def weights() -> DAPGWeights:
    return random_weights()


@pytest.fixture
def npz(weights, tmp_path) -> Path:
    np.savez(tmp_path / "door.npz", **weights._asdict(), log_std=np.zeros(N_OUT))
    return tmp_path / "door.npz"


@pytest.fixture
def mjrl(monkeypatch):
    """The two classes of mjrl, as its modules define them; the reader must never ask for them."""
    module = types.ModuleType("mjrl.policies.gaussian_mlp")

    class MLP:
        pass

    class MuNet(torch.nn.Module):
        pass

    for kind in (MLP, MuNet):
        kind.__module__, kind.__qualname__ = module.__name__, kind.__name__
        setattr(module, kind.__name__, kind)
    for name in ("mjrl", "mjrl.policies"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return module


def policy(mjrl, weights: DAPGWeights):
    """An mjrl policy in memory, with what else its class keeps."""
    model = mjrl.MuNet()
    for index in range(3):
        layer = torch.nn.Linear(1, 1)
        layer.weight = torch.nn.Parameter(torch.tensor(weights[2 * index]).T.contiguous().T)  # strides other than C's
        layer.bias = torch.nn.Parameter(torch.tensor(weights[2 * index + 1]))
        setattr(model, f"fc{index}", layer)
    for name in ("in_shift", "in_scale", "out_shift", "out_scale"):
        setattr(model, name, torch.tensor(getattr(weights, name)))
    made = mjrl.MLP()
    made.model, made.old_model = model, model
    made.log_std = torch.zeros(N_OUT, requires_grad=True)
    made.trainable_params = [*model.parameters(), made.log_std]
    made.log_std_val = np.zeros(N_OUT)
    made.d = np.sum([3, 4])
    made.nonlinearity = torch.tanh
    return made


class OldTorchPickler(pickle.Pickler):
    """Writes tensors as PyTorch 0.3 did: Variables around tensors around storages of plain numbers."""

    def reducer_override(self, thing):
        if isinstance(thing, torch.Tensor):
            return Variable, (_Tensor(thing.detach()),), (True, False, None)
        if isinstance(thing, _Tensor):
            tensor = thing.tensor
            storage = _Storage(tensor.untyped_storage())
            return torch._utils._rebuild_tensor, (
                storage,
                tensor.storage_offset(),
                tuple(tensor.shape),
                tensor.stride(),
            )
        if isinstance(thing, _Storage):
            return torch.FloatStorage, (np.frombuffer(bytes(thing.storage), np.float32).tolist(),)
        return NotImplemented


class _Tensor:
    def __init__(self, tensor):
        self.tensor = tensor


class _Storage:
    def __init__(self, storage):
        self.storage = storage


def pickled(thing, pickler=pickle.Pickler, protocol: int = 2) -> bytes:
    file = io.BytesIO()
    pickler(file, protocol).dump(thing)
    return file.getvalue()


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_the_expert_is_the_formula(weights):
    observation = np.random.default_rng(1).normal(size=N_IN)
    w = {name: array.astype(np.float64) for name, array in weights._asdict().items()}
    normalised = (observation - w["in_shift"]) / (w["in_scale"] + 1e-8)
    first = np.tanh(w["W0"] @ normalised + w["b0"])
    second = np.tanh(w["W1"] @ first + w["b1"])
    expected = (w["W2"] @ second + w["b2"]) * w["out_scale"] + w["out_shift"]
    np.testing.assert_allclose(DAPGExpert(weights).mean_action(observation), expected, rtol=1e-4)


def test_arrays_are_read_back(npz, weights):
    for read, written in zip(DAPGWeights.read(npz), weights, strict=True):
        np.testing.assert_array_equal(read, written)


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize("pickler", [pickle.Pickler, OldTorchPickler])
def test_a_pickle_is_read_as_the_policy_it_holds(pickler, protocol, mjrl, weights, tmp_path, monkeypatch):
    path = write(tmp_path / "door-v0.pickle", pickled(policy(mjrl, weights), pickler, protocol))
    for name in [name for name in sys.modules if name.startswith("mjrl")]:
        monkeypatch.setitem(sys.modules, name, None)  # from here on, importing mjrl fails
    for read, written in zip(DAPGWeights.read(path), weights, strict=True):
        np.testing.assert_array_equal(read, written)


def test_a_policy_fits_one_task_only(npz, weights):
    weights.check_task("door", npz)
    line = r"door\.npz' does not fit relocate: it maps 39 observations to 28 actions, relocate has 39 and 30\."
    with pytest.raises(UserError, match=line):
        weights.check_task("relocate", npz)
    for task in TASKS:
        simulator = make_simulator(task)
        assert simulator.action_space.shape == (len(TASKS[task].joints),)


# Bad input ----------------------------------------------------------------------------------------------------------


class Imports:
    def __init__(self, function, *arguments):
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


@pytest.mark.parametrize(
    ("function", "arguments"),
    [(os.system, ("touch {}",)), (eval, ("open('{}', 'w')",)), (copyreg.add_extension, ("os", "system", 1))],
)
def test_a_pickle_that_imports_something_is_refused_and_does_nothing(function, arguments, tmp_path):
    harm = tmp_path / "harm"
    thing = Imports(function, *(a.format(harm) if isinstance(a, str) else a for a in arguments))
    path = write(tmp_path / "door.pickle", pickled({"policy": thing}))
    with pytest.raises(UserError, match=rf"'{path}' does not contain a DAPG policy: it asks for \w+\.\w+, which no "):
        DAPGWeights.read(path)
    assert not harm.exists()


def test_names_of_torch_are_never_run(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "load", lambda *_: pytest.fail("was run"))
    thing = Imports(torch.save, {}, str(tmp_path / "harm"))
    with pytest.raises(UserError, match="does not contain a DAPG policy"):
        DAPGWeights.read(write(tmp_path / "door.pickle", pickled(thing)))
    assert not (tmp_path / "harm").exists()


def test_bytes_inside_a_pickle_are_not_unpickled_freely_either(tmp_path):
    inner = pickled(Imports(os.system, f"touch {tmp_path}/harm"))
    thing = Imports(torch.storage._load_from_bytes, inner)
    with pytest.raises(UserError, match="does not contain a DAPG policy"):
        DAPGWeights.read(write(tmp_path / "door.pickle", pickled(thing)))
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("pickler", [pickle.Pickler, OldTorchPickler])
def test_a_truncated_pickle(pickler, share, mjrl, weights, tmp_path):
    content = pickled(policy(mjrl, weights), pickler)
    path = write(tmp_path / "door.pickle", content[: int(share * len(content))])
    with pytest.raises(UserError, match=rf"^'{path}' does not contain a DAPG policy: .+$"):
        DAPGWeights.read(path)


def test_a_pickle_of_something_else(tmp_path):
    with pytest.raises(UserError, match="'dict' object has no attribute 'trainable_params'"):
        DAPGWeights.read(write(tmp_path / "door.pickle", pickled({})))


def test_a_tensor_larger_than_its_storage(tmp_path):
    thing = Imports(torch._utils._rebuild_tensor, Imports(torch.FloatStorage, [1.0]), 0, (10**6, 10**6), (1, 1))
    with pytest.raises(UserError, match=r"it has a tensor of size \(1000000, 1000000\) in a storage of 1 numbers"):
        DAPGWeights.read(write(tmp_path / "door.pickle", pickled(thing)))


def test_arrays_without_a_policy(npz, weights, tmp_path):
    with pytest.raises(UserError, match=r"Cannot read the expert's weights: .*No such file.*none\.npz"):
        DAPGWeights.read(tmp_path / "none.npz")
    with pytest.raises(UserError, match="does not contain a DAPG policy"):
        DAPGWeights.read(write(tmp_path / "cut.npz", npz.read_bytes()[:-300]))
    np.savez(tmp_path / "half.npz", W0=weights.W0)
    with pytest.raises(UserError, match=r"does not contain a DAPG policy: .*b0"):
        DAPGWeights.read(tmp_path / "half.npz")
    np.savez(tmp_path / "wrong.npz", **weights._replace(b1=weights.b1[:-1])._asdict())
    with pytest.raises(UserError, match=r"does not contain a DAPG policy: W1 must have shape \(3, 5\), got \(4, 5\)"):
        DAPGWeights.read(tmp_path / "wrong.npz")
    np.savez(tmp_path / "nan.npz", **weights._replace(b1=weights.b1 * np.nan)._asdict())
    with pytest.raises(UserError, match="does not contain a DAPG policy: b1 must be finite"):
        DAPGWeights.read(tmp_path / "nan.npz")
    np.savez(tmp_path / "object.npz", **{**weights._asdict(), "b1": np.array([{}])})
    with pytest.raises(UserError, match=r"does not contain a DAPG policy: .*allow_pickle=False"):
        DAPGWeights.read(tmp_path / "object.npz")


def text(content: str) -> bytes:
    return b"X" + len(content).to_bytes(4, "little") + content.encode()


def doubling_tuple() -> bytes:
    """A tuple of itself and itself, 60 times over: its hash takes 2^60 steps."""
    return b"N\x85" + b"".join(b"q%ch%c\x86" % (level, level) for level in range(60))


HOSTILE_PICKLES = {
    "a key": b"}" + doubling_tuple() + b"Ns.",
    "keys": b"}(" + doubling_tuple() + b"Nu.",
    "keys of a dictionary": b"(" + doubling_tuple() + b"Nd.",
    "values of a set": b"c__builtin__\nset\n](" + doubling_tuple() + b"e\x85R.",
    "values of a new set": b"\x8f(" + doubling_tuple() + b"\x90.",
    "values of a frozen set": b"(" + doubling_tuple() + b"\x91.",
    "keys in order": b"ccollections\nOrderedDict\n](](" + doubling_tuple() + b"Neee\x85R.",
    "a deep key": b"}N" + b"\x85" * 100_000 + b"Ns.",
    "a list of itself": b"]q\x00h\x00a.",
    "a variable of itself": b"cmjrl.policies\nMLP\n)\x81}("
    + text("trainable_params")
    + b"]ctorch.autograd.variable\nVariable\n)\x81q\x00}"
    + text("arguments")
    + b"h\x00\x85sba"
    + text("model")
    + b"Nub.",
}


@pytest.mark.parametrize("content", HOSTILE_PICKLES.values(), ids=HOSTILE_PICKLES)
@pytest.mark.parametrize("inside", [False, True], ids=["outside", "in PyTorch's bytes"])
def test_values_that_take_for_ever_are_refused(content, inside, tmp_path):
    content = b"\x80\x04" + content
    if inside:
        encoded = content.decode("latin1")
        content = b"\x80\x02ctorch.storage\n_load_from_bytes\nc_codecs\nencode\n" + text(encoded)
        content += text("latin1") + b"\x86R\x85R."
    (tmp_path / "door.pickle").write_bytes(content)
    with pytest.raises(UserError, match="does not contain a DAPG policy"):
        DAPGWeights.read(tmp_path / "door.pickle")


@pytest.mark.parametrize("name", ["door.npz", "door.pickle"])
def test_a_pipe_is_not_waited_for(name, tmp_path):
    os.mkfifo(tmp_path / name)
    with pytest.raises(UserError, match="is not a file"):
        DAPGWeights.read(tmp_path / name)


def test_arrays_without_dimensions(tmp_path):
    np.savez(tmp_path / "door.npz", **dict.fromkeys(DAPGWeights._fields, np.float32(1)))
    with pytest.raises(UserError, match=r"W0 must have shape \(1, 1\), got \(\)"):
        DAPGWeights.read(tmp_path / "door.npz")


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "door.pickle").open("wb") as file:
        file.truncate(dapg_pickle.MAX_BYTES + 1)
    with pytest.raises(UserError, match="it has more than"):
        DAPGWeights.read(tmp_path / "door.pickle")
