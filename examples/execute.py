"""Execute the notebooks of this folder in fresh kernels and store their outputs.

Figures are stored small.

python examples/execute.py
"""

import base64
import io
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).resolve().parent


def executed(path: Path, timeout_s: float = 600.0) -> nbformat.NotebookNode:
    """Return a notebook with the outputs of a new kernel, which works in the folder of the notebook.

    Raises: nbclient.exceptions.CellExecutionError: a cell raised an error.
    """
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, timeout=timeout_s, resources={"metadata": {"path": str(path.parent)}}
    )
    return client.execute()


def shrink(notebook: nbformat.NotebookNode) -> None:
    """Make the figures of a notebook small, and leave out times of execution."""
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", ()):
            picture = output.get("data", {}).get("image/png")
            if picture is not None:
                small = io.BytesIO()
                Image.open(io.BytesIO(base64.b64decode(picture))).reduce(2).save(
                    small, format="png"
                )
                output["data"]["image/png"] = base64.b64encode(small.getvalue()).decode()


def main() -> None:
    """Execute all notebooks."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        notebook = executed(path)
        shrink(notebook)
        nbformat.write(notebook, path)
        print(path.name)


if __name__ == "__main__":
    main()
