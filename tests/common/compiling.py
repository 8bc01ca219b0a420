"""Compile Triton's kernels for GPUs that are not there: what a script would launch is compiled, and not run."""

from __future__ import annotations

import os
import subprocess
import sys

# What the interpreter takes and the compilers refuse, no other test without a GPU would see.
_PREAMBLE = """
import triton, torch
from triton.backends import backends
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.runtime.jit import JITFunction

TARGETS = [GPUTarget("cuda", 80, 32), GPUTarget("cuda", 90, 32)]
if "amd" in backends:
    TARGETS.append(GPUTarget("hip", "gfx942", 64))
TYPES = {torch.float32: "fp32", torch.float64: "fp64", torch.int16: "i16", torch.int32: "i32", torch.int64: "i64",
         torch.uint8: "u8", torch.bool: "i1"}
seen = set()


def compile_instead(kernel, *positional, grid, warmup, **named):
    values = dict(zip(kernel.arg_names, positional))
    values |= {name: named.pop(name) for name in list(named) if name in kernel.arg_names}
    signature, constants, attributes = {}, {}, {}
    for number, parameter in enumerate(kernel.params):
        name = parameter.name
        value = values[name] if name in values else parameter.default
        if parameter.is_constexpr or value is None:
            signature[name], constants[(number,)] = "constexpr", value
        elif isinstance(value, torch.Tensor):
            signature[name], attributes[(number,)] = "*" + TYPES[value.dtype], [["tt.divisibility", 16]]
        else:
            signature[name] = "i1" if isinstance(value, bool) else "i32" if isinstance(value, int) else "fp32"
    launch = kernel.__name__, tuple(signature.values()), tuple(constants.items()), tuple(named.items())
    if launch not in seen:
        seen.add(launch)
        for target in TARGETS:
            source = ASTSource(fn=kernel, signature=signature, constexprs=constants, attrs=attributes)
            triton.compile(source, target=target, options=named)
            print("compiled", kernel.__name__, target.arch)


JITFunction.run = compile_instead
"""


def compiled(script: str) -> dict[str, set[str]]:
    """Run the script with every launch replaced by compilations; the names of the kernels, each with its targets.

    The script's tensors stay on the CPU; what kernels would have written is not there.
    """
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    command = [sys.executable, "-c", _PREAMBLE + script]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-6000:]
    kernels: dict[str, set[str]] = {}
    for line in done.stdout.splitlines():
        if line.startswith("compiled "):
            _, name, target = line.split()
            kernels.setdefault(name, set()).add(target)
    return kernels
