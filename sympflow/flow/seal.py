"""Give files of flows from earlier versions the seal of their architecture; weights and figures stay as they are.

python -m sympflow.flow.seal              those that ship with the package
python -m sympflow.flow.seal FILE ...     these
"""

from __future__ import annotations

import argparse
from importlib import resources
from pathlib import Path

from sympflow.flow.io import reseal


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m sympflow.flow.seal", description="Seal files of flows.")
    parser.add_argument("files", nargs="*", type=Path, metavar="file", help="all that ship, if none is named")
    files = parser.parse_args(arguments).files
    for file in files or sorted((Path(str(resources.files("sympflow"))) / "pretrained").glob("*.safetensors")):
        print(file.name, "sealed" if reseal(file) else "has a seal")


if __name__ == "__main__":
    main()
