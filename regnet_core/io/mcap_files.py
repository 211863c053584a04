"""The files of a rosbag2 recording in MCAP format, and reading them with errors that name the file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import yaml
from mcap.reader import McapReader, make_reader

from regnet_core.errors import BagError, CloudError


def is_mcap(file: Path) -> bool:
    """Whether the file is named as MCAP files are."""
    return file.suffix.lower() == ".mcap"


def bag_files(path: Path) -> list[Path]:
    """The .mcap files of a bag, a folder or one file, in their order.

    Raises:
        BagError: there is no such bag, or a file of it is missing.
    """
    if not path.exists():
        raise BagError(f"there is no bag '{path}'")
    if path.is_file():
        return [path]
    files = sorted(filter(is_mcap, path.iterdir()))
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        named = [path / name for name in _named_files(metadata) if is_mcap(Path(name))]
        missing = [file.name for file in named if not file.is_file()]
        if missing:
            raise BagError(f"the bag '{path}' lacks {', '.join(missing)}, which its metadata.yaml names")
        files = named or files
    if not files:
        others = ", ".join(sorted({file.suffix for file in path.iterdir() if file.suffix})) or "nothing"
        raise BagError(
            f"the folder '{path}' holds no .mcap file (it holds {others}); other bags can be converted with "
            "'ros2 bag convert'"
        )
    return files


def _named_files(metadata: Path) -> list[str]:
    try:
        names = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]["relative_file_paths"]
    except yaml.MarkedYAMLError as error:
        where = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise BagError(f"'{metadata}' is not valid YAML: {error.problem}{where}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BagError(f"'{metadata}' is not a text file: {' '.join(str(error).split())}") from error
    except (KeyError, TypeError):
        names = None
    if not isinstance(names, list):
        raise BagError(
            f"'{metadata}' is not a rosbag2 metadata file: it has no list rosbag2_bagfile_information, "
            "relative_file_paths"
        )
    return [str(name) for name in names]


@contextlib.contextmanager
def open_mcap(file: Path) -> Iterator[McapReader]:
    """A reader of the file; whatever goes wrong while it is read becomes a BagError that names the file.

    mcap raises its own errors for some defects, struct, key, Unicode and compression errors for others.
    """
    try:
        with file.open("rb") as stream:
            yield make_reader(stream)
    except BagError as error:
        raise BagError(f"{file.name}: {error}") from error
    except CloudError as error:
        raise CloudError(f"{file.name}: {error}") from error
    except Exception as error:
        detail = str(error) or type(error).__name__
        raise BagError(f"'{file}' cannot be read as an MCAP file: {detail}") from error
