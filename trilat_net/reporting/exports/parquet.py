"""A folder of Parquet files: a file per site and kind."""

import io
from pathlib import Path

from ...log.data_tables import Table, to_data_frame
from ...log.log_reader import Log
from ..export import ExportFormat, Written, describe_folder, store_tables


def _write(log: Log, folder: Path, written: Written) -> None:
    def store(table: Table, name: str) -> None:
        made = io.BytesIO()  # a full disk is reported here, not by polars
        to_data_frame(table).write_parquet(made, compression="zstd")
        (folder / name).write_bytes(made.getbuffer())

    describe_folder(
        log, folder, store_tables(log, written, lambda table: f"{table.label}.parquet", store)
    )


FORMAT = ExportFormat(
    _write, "-parquet", folder=True, extra=("polars", "frames", "Parquet files")
)
