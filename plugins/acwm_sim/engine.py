"""Import Taichi and start it once per process, with helpful errors if something is missing."""

import contextlib
import functools
import inspect
import io
import linecache
import operator
import os
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator
from multiprocessing.util import Finalize
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from acwm_core.env.environment import check_process
from acwm_core.errors import AcwmError, AcwmWarning
from acwm_core.files import cache_folder
from acwm_sim.shell import undisturbed

CACHE = "TI_OFFLINE_CACHE_FILE_PATH"
"""Environment variable for the folder of compiled kernels, the only one of Taichi's that counts."""

_VARIABLES = ("TI_", "ENABLE_TAICHI")  # they change results, and where and how fast it computes


def _give_home() -> None:
    """Name a home to Taichi, which asks for it again and again and aborts a process without one."""
    if "HOME" not in os.environ:
        try:
            os.environ["HOME"] = str(Path.home())
        except RuntimeError:  # a user without an account, as in some containers
            os.environ["HOME"] = str(cache_folder())


def _statement(frame: FrameType) -> str:
    """The line that a frame is at."""
    return linecache.getline(frame.f_code.co_filename, frame.f_lineno)


@contextlib.contextmanager
def _frames_told_by_line() -> Iterator[None]:
    """Let `inspect.getframeinfo` read the line of a frame, and do no more.

    Taichi asks at each of its own hundred decorators what it stands in, and `inspect` searches all
    imported modules for the answer: many seconds where torch was imported before.
    """
    usual = inspect.getframeinfo

    def told(frame: Any, context: int = 1) -> Any:
        if context != 1 or not inspect.isframe(frame):
            return usual(frame, context)
        code = frame.f_code
        line = [_statement(frame)]
        return inspect.Traceback(code.co_filename, frame.f_lineno, code.co_name, line, 0)

    inspect.getframeinfo = told
    try:
        yield
    finally:
        inspect.getframeinfo = usual


_give_home()
try:
    with undisturbed(*_VARIABLES, ENABLE_TAICHI_HEADER_PRINT="0"), _frames_told_by_line():
        import taichi as ti
        from taichi.lang import impl, kernel_impl
        from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
except ImportError as error:
    if "libX11" in str(error):
        raise AcwmError(
            "The renderer (taichi) cannot be loaded because the system library libX11 is missing: "
            "sudo apt-get install libx11-6"
        ) from error
    raise

__all__ = ["CACHE", "Launcher", "start", "ti"]

# Taichi reads the source of a function at each of its calls, and draws each expression as text for
# the case of an error: more than half of the time before the first frame. Neither ends in a kernel.
kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)
kernel_impl.getsourcefile = functools.cache(kernel_impl.getsourcefile)


def _position(self: Any, node: Any) -> str:
    line, function = node.lineno + self.lineno_offset, self.func.func.__name__
    return f'File "{self.file}", line {line}, in {function}:\n'


ASTTransformerContext.get_pos_info = _position


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Whether the statement of the frame that many levels up begins a class, for decorators."""
    line = _statement(sys._getframe(level_of_class_stackframe)).strip()
    return any(pattern.match(line) for pattern in kernel_impl._KERNEL_CLASS_STACKFRAME_STMT_RES)


kernel_impl._inside_class = _inside_class

_started_in: int | None = None


def start() -> None:
    """Initialise Taichi for this process; later calls do nothing.

    It uses one thread and no fields: kernels run over numpy arrays and give identical bits in
    every process. A second initialisation would drop all compiled kernels, so always start Taichi
    through this function.

    Raises:
        AcwmError: called from a thread other than the main one, or in a process forked after the
            start (Taichi hangs there; start workers with the "spawn" method instead).
    """
    global _started_in
    if _started_in == os.getpid():
        return
    check_process(_started_in)
    if threading.current_thread() is not threading.main_thread():
        raise AcwmError(
            "Environments that render must be created in the main thread of a process: "
            "use processes (spawn), not threads, to simulate in parallel"
        )
    if impl.get_runtime().prog is None:  # otherwise someone else has already started it
        _initialise()
        # Taichi keeps what it compiled on disk when it is torn down; at the end of a process with
        # torch and an environment it is not. Unlike atexit, Finalize also runs in workers.
        Finalize(None, ti.reset, exitpriority=0)
    _started_in = os.getpid()


class Launcher:
    """Launches a kernel again and again over the same arrays.

    Taichi examines every argument at each call of a kernel: for some twenty arrays that takes as
    long as drawing a small frame. A launcher lets it do so only when an argument is another object
    than at the previous launch. So what changes from launch to launch belongs into an array.

    Args:
        kernel: a Taichi kernel that returns nothing. Its arguments are contiguous arrays, integers,
            numbers, and templates.
    """

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel._primal
        self._arguments: tuple[Any, ...] = ()

    def __call__(self, *arguments: Any) -> None:
        if len(self._arguments) != len(arguments) or not all(
            map(operator.is_, arguments, self._arguments)
        ):
            self._prepare(arguments)
        self._program.launch_kernel(self._compiled, self._context)

    def _prepare(self, arguments: tuple[Any, ...]) -> None:
        """What Taichi's own call does before a launch."""
        built = self._kernel.compiled_kernels[self._kernel.ensure_compiled(*arguments)]
        program: Any = impl.get_runtime().prog
        context, place = built.make_launch_context(), 0
        for argument, declared in zip(arguments, self._kernel.arguments, strict=True):
            if isinstance(declared.annotation, ti.template):
                continue
            if isinstance(argument, np.ndarray):
                assert argument.flags.c_contiguous
                shape = argument.shape[: declared.annotation.ndim]
                address, size = int(argument.ctypes.data), argument.nbytes
                context.set_arg_external_array_with_shape((place,), address, size, shape, 0)
            elif declared.annotation is ti.i32:
                context.set_arg_int((place,), int(argument))
            else:
                context.set_arg_float((place,), float(argument))
            place += 1
        self._program, self._context, self._arguments = program, context, arguments
        device = program.get_device_caps()
        self._compiled = program.compile_kernel(program.config(), device, built)


def _initialise() -> None:
    folder = _cache()
    # It would ask its makers for a newer version, and it prints to stdout, which may be data.
    with (
        undisturbed(*_VARIABLES, TI_SKIP_VERSION_CHECK="ON"),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        ti.init(
            arch=ti.cpu,
            cpu_max_num_threads=1,
            offline_cache=True,
            offline_cache_file_path=str(folder),
            log_level=ti.ERROR,
            random_seed=0,
        )


def _cache() -> Path:
    """The folder of compiled kernels; a temporary one, with a warning, if none can be written."""
    if chosen := os.environ.get(CACHE):
        folders = [Path(chosen)]
    else:
        folders = [Path(impl.default_cfg().offline_cache_file_path), cache_folder() / "taichi"]
    why = ""
    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError as error:
            why = f"{folder} ({error.strerror})"
    warnings.warn(
        f"compiled kernels cannot be kept in {why}, so every command compiles its own, in 10 to 20 "
        f"seconds: set {CACHE} to another folder",
        AcwmWarning,
        stacklevel=2,
    )
    temporary = tempfile.TemporaryDirectory(prefix="acwm-")
    Finalize(None, temporary.cleanup, exitpriority=-1)  # after Taichi has written there
    os.environ[CACHE] = temporary.name  # also of child processes
    return Path(temporary.name)
