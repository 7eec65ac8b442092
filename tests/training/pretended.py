"""An accelerator that does not exist: its tensors compute on the CPU, and tell what a GPU would.

PyTorch lets a program register a device. A `Pretended` tensor says that it lies there, and holds a
tensor of the CPU that computes for it. So everything runs, with the numbers of the CPU, while

* an operation on tensors of both devices is an error, as it is on a GPU;
* whatever makes a program wait for a GPU is noted: reading a number, a copy to the CPU or from
  memory that is not page-locked, and results whose shape depends on values.
"""

import traceback
from contextlib import nullcontext

import torch
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch.nn.attention import SDPBackend
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.weak import WeakIdKeyDictionary

NAME = "pretended"
aten = torch.ops.aten


class WrongDeviceError(Exception):
    """An operation got tensors of both devices."""


class Pretended(torch.Tensor):
    """A tensor of the pretended device; `held` holds its values."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, held):
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset()}
        device = torch.device(NAME, 0)
        made = cls._make_wrapper_subclass(
            cls, held.shape, dtype=held.dtype, device=device, **layout
        )
        made.held = held
        return made

    def __reduce_ex__(self, protocol):
        return self.held.__reduce_ex__(protocol)

    def tolist(self):
        return self.cpu().tolist()

    def __repr__(self):
        return f"Pretended({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


class Waits(TorchDispatchMode):
    """While it is active, the device exists. Its wrappers do without gradients in inference mode.

    Attributes:
        place: where the program is; None notes nothing.
        noted: what the program would have waited for, by place.
    """

    def __init__(self, place=None):
        super().__init__()
        self.place, self.noted = place, {}

    def __enter__(self):
        if not hasattr(torch, NAME):
            backend_registration._setup_privateuseone_for_python_backend(NAME, _Module(), _Hook())
        _Hook.is_there = True
        torch._C._set_only_lift_cpu_tensors(True)  # `torch.tensor` copies, so that it is seen
        torch.inference_mode = lambda mode=True: torch.no_grad() if mode else nullcontext()
        _ACTIVE.append(self)
        return super().__enter__()

    def __exit__(self, *error):
        _Hook.is_there = False
        torch._C._set_only_lift_cpu_tensors(False)
        torch.inference_mode = _INFERENCE
        _ACTIVE.pop()
        return super().__exit__(*error)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})

    def note(self, what):
        if self.place is not None:
            stack = traceback.StackSummary.extract(traceback.walk_stack(None), lookup_lines=False)
            where = next(
                (f"{e.filename}:{e.lineno}" for e in stack if _is_product(e.filename)), "?"
            )
            self.noted.setdefault(self.place, []).append(f"{what}, at {where}")


_ACTIVE: list[Waits] = []
_PINNED = WeakIdKeyDictionary()
_INFERENCE = torch.inference_mode


def _is_product(file):
    return "acwm_" in file or "site-packages/lightning" in file or "torch/optim" in file


class _Hook(backend_registration._DummyPrivateUse1Hook):
    is_there = False

    def is_available(self):
        return self.is_there


class _Module(backend_registration._DummyBackendModule):
    def is_available(self):
        return _Hook.is_there

    def get_amp_supported_dtype(self):
        return [torch.bfloat16]


def _run(func, args, kwargs):
    tensors = [each for each in _flat((*args, *kwargs.values())) if isinstance(each, torch.Tensor)]
    on_device = any(isinstance(each, Pretended) for each in tensors)
    device = kwargs.get("device")
    to_device = device is not None and torch.device(device).type == NAME
    note = _ACTIVE[-1].note
    if func is aten._pin_memory.default:
        pinned = args[0].clone()
        _PINNED[pinned] = True
        return pinned
    if func is aten.is_pinned.default:
        return args[0] in _PINNED
    if not on_device and not to_device:
        return func(*args, **kwargs)
    if to_device:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if func in _SPECIAL:
        return _SPECIAL[func](func, note, to_device, *args, **kwargs)
    _check_devices(func, note, tensors)
    _check_shapes(func, note, tensors)
    out = func(*_mapped(_real, args), **{name: _mapped(_real, v) for name, v in kwargs.items()})
    return _returned(func, note, args, kwargs, out)


def _flat(values):
    for each in values:
        if isinstance(each, list | tuple):
            yield from _flat(each)
        else:
            yield each


def _mapped(change, value):
    if isinstance(value, list | tuple):
        return type(value)(_mapped(change, each) for each in value)
    return change(value)


def _real(value):
    return value.held if isinstance(value, Pretended) else value


def _made(value):
    return Pretended(value) if isinstance(value, torch.Tensor) else value


def _returned(func, note, args, kwargs, out):
    if isinstance(out, bool | int | float):
        note(f"{func} gives the program a number")
        return out
    changed = [
        each for each in func._schema.arguments if each.alias_info and each.alias_info.is_write
    ]
    if not isinstance(out, torch.Tensor) or not changed:
        return _mapped(_made, out)
    if changed[0].name in kwargs:
        return kwargs[changed[0].name]
    return args[[each.name for each in func._schema.arguments].index(changed[0].name)]


_INDEXING = (
    *(aten.index.Tensor, aten.index_put.default, aten.index_put_.default),
    *(aten._index_put_impl_.default, aten._unsafe_index.Tensor),
)


def _check_devices(func, note, tensors):
    others = [each for each in tensors if not isinstance(each, Pretended) and each.ndim]
    if not others:
        return
    if func in _INDEXING and isinstance(tensors[0], Pretended) and others[0] is not tensors[0]:
        note(f"{func} copies indices of the CPU")
        return
    raise WrongDeviceError(f"{func} got tensors of the CPU, e.g. {[*others[0].shape]}")


def _check_shapes(func, note, tensors):
    if func in _INDEXING:
        indices = tensors[1:] if "put" not in func.name() else tensors[1:-1]
        if any(each.dtype in (torch.bool, torch.uint8) for each in indices):
            note(f"{func} counts what a mask selects")
    elif {torch.Tag.dynamic_output_shape, torch.Tag.data_dependent_output} & {*func.tags}:
        note(f"{func} gives a shape that depends on values")


def _copied(func, note, to_device, tensor, **kwargs):
    is_there = isinstance(tensor, Pretended)
    leaves = kwargs.get("device") is not None and not to_device
    if is_there and leaves:
        note("a copy to the CPU")
    elif not is_there and not (kwargs.get("non_blocking") and tensor in _PINNED):
        note("a copy from memory that is not page-locked, or that waits")
    made = func(_real(tensor), **kwargs)
    if made is _real(tensor):
        made = made.clone()
    return made if is_there and leaves else Pretended(made)


def _copied_into(func, note, to_device, target, source, non_blocking=False):
    if isinstance(target, Pretended) and not isinstance(source, Pretended) and source.ndim:
        if not (non_blocking and source in _PINNED):
            note("a copy from memory that is not page-locked, or that waits")
    elif not isinstance(target, Pretended):
        note("a copy to the CPU")
    func(_real(target), _real(source))
    return target


def _read(func, note, to_device, tensor):
    note("a number is read")
    return func(tensor.held)


def _math_attention(*args, **kwargs):
    return SDPBackend.MATH.value


def _gru(func, note, to_device, input_gates, hidden_gates, state, input_bias=None, bias=None):
    """The kernel that GPUs have, by its formula; `workspace` holds what its derivative needs."""
    ours, theirs, before = input_gates.held, hidden_gates.held, state.held
    if input_bias is not None:
        ours, theirs = ours + input_bias.held, theirs + bias.held
    (r, z, n), (hr, hz, hn) = ours.chunk(3, 1), theirs.chunk(3, 1)
    reset, update = (r + hr).sigmoid(), (z + hz).sigmoid()
    new = (n + reset * hn).tanh()
    after = new + update * (before - new)
    return Pretended(after), Pretended(torch.cat([reset, update, new, before, hn], 1))


def _gru_backward(func, note, to_device, grad, workspace, has_bias):
    reset, update, new, before, hidden = workspace.held.chunk(5, 1)
    of_new = grad.held * (1 - update) * (1 - new**2)
    of_update = grad.held * (before - new) * update * (1 - update)
    of_reset = of_new * hidden * reset * (1 - reset)
    ours = torch.cat([of_reset, of_update, of_new], 1)
    theirs = torch.cat([of_reset, of_update, of_new * reset], 1)
    biases = (ours.sum(0), theirs.sum(0)) if has_bias else (None, None)
    return tuple(map(_made, (ours, theirs, grad.held * update, *biases)))


_SPECIAL = {
    aten._to_copy.default: _copied,
    aten.copy_.default: _copied_into,
    aten._local_scalar_dense.default: _read,
    aten._fused_sdp_choice.default: _math_attention,
    aten._thnn_fused_gru_cell.default: _gru,
    aten._thnn_fused_gru_cell_backward.default: _gru_backward,
}


class PretendedAccelerator(CPUAccelerator):
    """What Lightning asks of a device."""

    def setup_device(self, device):
        pass


class PretendedStrategy(SingleDeviceStrategy):
    """Training on the pretended device: ``trainer.strategy`` of a recipe."""

    def __init__(self):
        super().__init__(torch.device(NAME, 0), accelerator=PretendedAccelerator())


class Steps(Callback):
    """Notes waits by the number of steps before, from a step's beginning to that of the next."""

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        _ACTIVE[-1].place = trainer.global_step

    def on_train_end(self, trainer, pl_module):
        _ACTIVE[-1].place = None
