"""Import Taichi and start it once per process, with helpful errors if something is missing."""

import contextlib
import functools
import io
import os
import threading
from multiprocessing.util import Finalize
from typing import Any

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")

from acwm_core.errors import AcwmError

try:
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

__all__ = ["start", "ti"]

# Taichi reads the source of a function at each of its calls, and draws each expression as text for
# the case of an error: more than half of the time before the first frame. Neither ends in a kernel.
kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)
kernel_impl.getsourcefile = functools.cache(kernel_impl.getsourcefile)


def _position(self: Any, node: Any) -> str:
    line, function = node.lineno + self.lineno_offset, self.func.func.__name__
    return f'File "{self.file}", line {line}, in {function}:\n'


ASTTransformerContext.get_pos_info = _position

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
    if _started_in is not None:
        raise AcwmError(
            "Taichi was started before this process was forked and cannot be used here: "
            "start workers with multiprocessing's 'spawn' method"
        )
    if threading.current_thread() is not threading.main_thread():
        raise AcwmError(
            "Environments that render must be created in the main thread of a process: "
            "use processes (spawn), not threads, to simulate in parallel"
        )
    if impl.get_runtime().prog is None:  # otherwise someone else has already started it
        with contextlib.redirect_stdout(io.StringIO()):  # it prints to stdout, which may be data
            ti.init(
                arch=ti.cpu,
                cpu_max_num_threads=1,
                offline_cache=True,
                log_level=ti.ERROR,
                random_seed=0,
            )
        # Taichi keeps what it compiled on disk when it is torn down; at the end of a process with
        # torch and an environment it is not. Unlike atexit, Finalize also runs in workers.
        Finalize(None, ti.reset, exitpriority=0)
    _started_in = os.getpid()
