"""The kernels on a 64-bit ARM processor, by a cross compiler and an emulator.

Debian: `apt-get install gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user-static`.
"""

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from transport.model.arrays import Array
from transport.model.kernels import compiler, native

DRIVER = Path(__file__).parents[1] / "data" / "every_kernel.c"
FLAGS = ("-O3", "-fno-math-errno", "-w")

CROSS_COMPILER = shutil.which("aarch64-linux-gnu-gcc")
EMULATOR = shutil.which("qemu-aarch64-static") or shutil.which("qemu-aarch64")

# Compilers fuse other products and sums for another processor: rounding, relative to the number or
# to 1; measured: 2e-15, and 2e-12 where this processor fuses none.
ROUNDING = 1e-11


def results(folder: Path, build: Sequence[str], *emulator: str) -> Array:
    """Return the numbers of all kernels in a program built by a command, run by an emulator."""
    program = str(folder / "every_kernel")
    kernels = Path(str(native.__file__)).parent
    source = [f"-I{kernels}", str(DRIVER), "-o", program, "-lm"]
    subprocess.run([*build, *FLAGS, *source], check=True, capture_output=True)
    run = subprocess.run([*emulator, program], check=True, capture_output=True)
    return np.frombuffer(run.stdout)


@pytest.mark.slow
def test_kernels_on_arm_are_those_of_this_processor(tmp_path: Path) -> None:
    """Hold, prediction, QP, solution, plan and response: equal up to rounding, as is the number of guesses."""
    own_compiler = compiler.find_compiler()
    if own_compiler is None or CROSS_COMPILER is None or EMULATOR is None:
        pytest.skip(f"compilers {own_compiler}, {CROSS_COMPILER}, emulator {EMULATOR}: all needed")

    here = results(tmp_path, [own_compiler, *compiler.processor_flags()])
    on_arm = results(tmp_path, [CROSS_COMPILER, "-static"], EMULATOR)
    assert here.size > 10_000
    assert np.isnan(here).sum() == 0
    np.testing.assert_allclose(on_arm, here, rtol=ROUNDING, atol=ROUNDING)
