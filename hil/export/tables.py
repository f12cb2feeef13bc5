"""CSV, Parquet and MAT export: the recording as columns, with the result if the format has a place for it."""

import csv
import io
from pathlib import Path

import numpy as np

from hil.errors import RunFolderError
from hil.export.columns import columns, unit
from hil.export.source import MissingPackages, Recorded
from hil.model_file import model_of
from hil.whole_file import write_whole


def export_csv(source: Recorded, path: Path) -> list[str]:
    """Write the CSV file `path` at full precision; missing values are written as nan."""
    table = columns(source)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*(column.tolist() for column in table.values()), strict=True))
    write_whole(path, text.getvalue())
    return [
        "the identified parameters (a CSV file holds a single table; export them to TOML or JSON)",
        "units (SI, temperature in degrees C)",
    ]


def export_parquet(source: Recorded, path: Path) -> list[str]:
    """Write the Parquet file `path`; its metadata holds the columns' units and result.json. Needs pyarrow."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise MissingPackages("Parquet needs the package pyarrow") from error
    table = columns(source)
    fields = [
        pa.field(name, pa.from_numpy_dtype(col.dtype), metadata={"unit": unit(name)}) for name, col in table.items()
    ]
    schema = pa.schema(fields, metadata={"hil_result": source.result_json})
    arrays = [pa.array(np.ascontiguousarray(column)) for column in table.values()]
    try:
        parquet.write_table(pa.Table.from_arrays(arrays, schema=schema), path)
    except OSError as error:
        raise RunFolderError(f"{path} cannot be written: {error}.") from error
    return []


def export_mat(source: Recorded, path: Path) -> list[str]:
    """Write the MAT file `path` for MATLAB and Octave: structs `samples`, `units`, `parameters` and `std`, and
    result.json as text.
    """
    from scipy.io import savemat

    table = columns(source)
    content: dict[str, object] = {
        "samples": dict(table),
        "units": {name: unit(name) for name in table},
        "result_json": source.result_json,
    }
    if source.result is not None:
        model = model_of(source.result, source.run)
        content |= {"parameters": dict(model.values), "std": dict(model.stds)}
    try:
        savemat(path, content, oned_as="column", do_compression=True, long_field_names=True)
    except OSError as error:
        raise RunFolderError(f"{path} cannot be written: {error}.") from error
    return []
