"""Makes torch 2.9.0's CUDA wheel importable on the CPU without its 2.5 GB of CUDA libraries.

    pip install --no-deps torch==2.9.0 nvidia-cuda-runtime-cu12==12.8.90 nvidia-cuda-cupti-cu12==12.8.90
    pip install numpy filelock typing_extensions sympy networkx jinja2 fsspec
    python tests/python/bare_torch.py

A plain `pip install torch==2.9.0` needs none of this. On Linux PyPI's only wheel of torch is the CUDA one; its
libraries name cuDNN, cuBLAS, NCCL and others as needed. The CPU's paths call none of their functions, so empty
libraries of those names beside torch's own are enough, as long as the functions are looked up when called and not at
import, which a line in `bare_torch.pth` sees to whenever this Python starts. Needs a C compiler. Libraries that the loader finds are left alone, and a second run does nothing.
"""

import importlib.util
import pathlib
import re
import subprocess
import tempfile


def missing(folder):
    """Names of the shared libraries that torch's own libraries need and the loader does not find."""
    found = set()
    for library in folder.glob("*.so"):
        report = subprocess.run(["ldd", str(library)], capture_output=True, text=True, check=True).stdout
        found.update(re.findall(r"^\s*(\S+) => not found", report, re.MULTILINE))
    return sorted(found)


def main():
    torch = pathlib.Path(importlib.util.find_spec("torch").origin).parent
    torch.with_name("bare_torch.pth").write_text("import os, sys; sys.setdlopenflags(os.RTLD_LAZY)\n")
    folder = torch / "lib"
    with tempfile.NamedTemporaryFile(suffix=".c") as empty:
        # A library that could not be loaded hides what it needs itself: look again until nothing is missing.
        while names := missing(folder):
            for name in names:
                print(f"empty {name}")
                target = str(folder / name)
                subprocess.run(["cc", "-shared", empty.name, "-o", target, f"-Wl,-soname,{name}"], check=True)


if __name__ == "__main__":
    main()
