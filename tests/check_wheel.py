"""Import the installed wheel beside Hugging Face's `datasets`, in an environment of its own (`make check-wheel`)."""

from importlib.metadata import files
from pathlib import PurePosixPath

import datasets
import rafl
import rafl.datasets

top_level = {PurePosixPath(path).parts[0] for path in files("rafl") or ()}
assert {name for name in top_level if not name.endswith(".dist-info") and name != ".."} == {"rafl"}, top_level
assert hasattr(datasets, "load_dataset")
assert rafl.simulate is not None
print(f"rafl {rafl.__version__} beside datasets {datasets.__version__}")
