"""The tables of a batch: writes rows as Parquet files in folders by date and vehicle, as DuckDB, Spark and pandas read
them, and queries them with SQL. The libraries for both are the optional extra `fleet`.
"""

import io
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import quote

from coec.errors import SourceError, UsageError
from coec.io import user_files
from coec.schemas.fleet import AXES, WindowRow
from coec.schemas.message import to_json
from coec.schemas.replies import Maybe6, Maybe6x6


def optional_library(name: str) -> Any:
    """A module of the extra.

    Raises:
        SourceError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise SourceError(
            "tables of many windows need the optional extra `fleet`: pip install 'coec[fleet]'"
        ) from error


NS_PER_S = 1_000_000_000

UNDATED, NAMELESS = "unknown", "unknown"
"""Folder names for date and vehicle of windows that could not be read. If a vehicle happens to have this name, its rows
still hold their own data."""


def table_schema() -> Any:
    """Columns of the table (a `pyarrow.Schema`); `date` and `vehicle` are the folders."""
    pa = optional_library("pyarrow")
    text, number, whole = pa.string(), pa.float64(), pa.int64()
    six = pa.list_(number, 6)
    return pa.schema(
        [
            ("url", text),
            ("sha256", text),
            ("bytes", whole),
            ("window_id", text),
            ("pair", text),
            ("camera_frame", text),
            ("lidar_frame", text),
            ("stamp_ns", whole),
            ("time", pa.timestamp("us", tz="UTC")),
            ("pairs", whole),
            *((axis, number) for axis in AXES),
            *((f"sigma_{axis}", number) for axis in AXES),
            ("correlation", pa.list_(number, 36)),
            ("camera_from_lidar", pa.list_(number, 16)),
            ("observed", pa.list_(pa.bool_(), 6)),
            ("accepted", pa.bool_()),
            ("reason_codes", pa.list_(text)),
            ("reasons", pa.list_(text)),
            ("figures", pa.map_(text, number)),
            ("limits", pa.map_(text, number)),
            ("independent_looks", number),
            ("score", number),
            ("score_at_start", number),
            ("mi", number),
            ("overlap", number),
            ("points_in_view", whole),
            ("evaluations", whole),
            ("stop_reason", text),
            ("first_derivative", six),
            ("second_derivative", six),
            ("depth_identity", text),
            ("config_hash", text),
            ("recorded_decision", text),
            ("decision", text),
            ("result", text),
            ("versions", pa.map_(text, text)),
            ("seconds", number),
            ("cpu_s", number),
            ("error_code", text),
            ("error", text),
        ]
    )


def write_tables(folder: Path, rows: Iterable[WindowRow], name: str) -> None:
    """Writes a file of this name for each date and vehicle, each completely or not at all.

    Raises:
        OutputError: a file cannot be written.
    """
    groups: dict[str, list[WindowRow]] = defaultdict(list)
    for row in rows:
        groups[_partition(row)].append(row)
    for partition, group in sorted(groups.items()):
        user_files.replace_output(folder / partition / f"{name}.parquet", _parquet(group))


def tabulated_urls(folder: Path) -> set[str]:
    """URLs of all windows that have a row in a folder.

    Raises:
        SourceError: a file is damaged.
    """
    parquet = optional_library("pyarrow.parquet")

    known: set[str] = set()
    for path in sorted(folder.glob("date=*/vehicle=*/*.parquet")):
        try:
            known.update(parquet.ParquetFile(path).read(["url"])["url"].to_pylist())
        except (OSError, ValueError, KeyError) as error:
            raise SourceError(f"{path} is damaged ({error}): remove it, and its windows are evaluated again") from error
    return known


def _partition(row: WindowRow) -> str:
    date = UNDATED if row.result is None else f"{_time(row.result.data_stamp_ns):%Y-%m-%d}"
    return f"date={date}/vehicle={quote(row.vehicle, safe='') or NAMELESS}"


def _time(stamp_ns: int) -> datetime:
    return datetime.fromtimestamp(stamp_ns // NS_PER_S, UTC)


def _parquet(rows: Sequence[WindowRow]) -> bytes:
    pa, parquet = optional_library("pyarrow"), optional_library("pyarrow.parquet")

    table = pa.Table.from_pylist([_row_values(row) for row in sorted(rows, key=lambda row: row.url)], table_schema())
    stream = io.BytesIO()
    parquet.write_table(table, stream, compression="zstd")
    return stream.getvalue()


def _row_values(row: WindowRow) -> dict[str, Any]:
    """The values of a row. Maps are in the order of their names, so that equal rows give equal bytes, also in a resumed
    batch."""
    fields: dict[str, Any] = {
        "url": row.url,
        "sha256": row.sha256,
        "bytes": row.bytes,
        "recorded_decision": row.recorded,
        "decision": row.decided,
        "versions": sorted(row.versions.items()),
        "seconds": row.seconds,
        "cpu_s": row.cpu_s,
        "error_code": row.error_code,
        "error": row.error,
    }
    result = row.result
    if result is None:
        return fields
    seen = zip(result.solved, result.unobservable, strict=True)
    return {
        **fields,
        "window_id": result.window_id,
        "pair": result.pair,
        "camera_frame": result.camera_frame,
        "lidar_frame": result.lidar_frame,
        "stamp_ns": result.data_stamp_ns,
        "time": _time(result.data_stamp_ns),
        "pairs": result.pairs,
        **dict(zip(AXES, result.correction, strict=True)),
        **{f"sigma_{axis}": value for axis, value in zip(AXES, result.sigma, strict=True)},
        "correlation": _correlation(result.noise),
        "camera_from_lidar": [value for line in result.camera_from_lidar.matrix for value in line],
        "observed": [solved and not blind for solved, blind in seen],
        "accepted": result.verdict.decision == "accepted",
        "reason_codes": [reason.code for reason in result.verdict.reasons],
        "reasons": [reason.text for reason in result.verdict.reasons],
        "figures": [(name, metric.value) for name, metric in sorted(result.metrics.items())],
        "limits": [(name, metric.limit) for name, metric in sorted(result.metrics.items())],
        "independent_looks": result.independent_looks,
        "score": result.score,
        "score_at_start": result.score_at_start,
        "mi": result.mi,
        "overlap": result.overlap,
        "points_in_view": result.points_in_view,
        "evaluations": result.evaluations,
        "stop_reason": result.stop_reason,
        "first_derivative": result.first_derivative,
        "second_derivative": result.second_derivative,
        "depth_identity": result.depth_identity,
        "config_hash": result.config_hash,
        "result": to_json(result).decode(),
    }


def _correlation(noise: Maybe6x6) -> list[float | None]:
    """Correlations of the noise, which differs from window to window, row by row; null where an axis is not known."""
    variances: Maybe6 = tuple(noise[axis][axis] for axis in range(6))  # type: ignore[assignment]
    return [
        None
        if covariance is None or not variances[a] or not variances[b]
        else covariance / ((variances[a] or 0.0) * (variances[b] or 0.0)) ** 0.5
        for a, line in enumerate(noise)
        for b, covariance in enumerate(line)
    ]


WINDOWS_VIEW = "windows"
"""Name of the view. It has one row per window, with `date` and `vehicle` from the folders."""

EXAMPLE_QUERIES: Mapping[str, str] = {
    "Which vehicles have drifted most in pitch over the last weeks?": f"""
SELECT vehicle, pair, max_by(rx_deg, time) - min_by(rx_deg, time) AS drift_deg, count(*) AS windows
FROM {WINDOWS_VIEW} WHERE accepted GROUP BY ALL ORDER BY abs(drift_deg) DESC LIMIT 20""",
    "Why are windows refused, and where?": f"""
SELECT reason, count(*) AS windows, count(DISTINCT vehicle) AS vehicles
FROM (SELECT vehicle, unnest(reason_codes) AS reason FROM {WINDOWS_VIEW} WHERE NOT accepted)
GROUP BY ALL ORDER BY windows DESC""",
    "Which windows could not be judged?": f"""
SELECT error_code, count(*) AS windows, any_value(url) AS for_example, any_value(error) AS says
FROM {WINDOWS_VIEW} WHERE error IS NOT NULL GROUP BY ALL ORDER BY windows DESC""",
    "Where does the cloud decide otherwise than the vehicle did?": f"""
SELECT vehicle, window_id, accepted, url FROM {WINDOWS_VIEW} WHERE recorded_decision <> decision ORDER BY time""",
    "What do the figures of accepted windows look like over the fleet?": f"""
SELECT figure.key AS figure, quantile_cont(figure.value, [0.005, 0.5, 0.995]) AS spread, count(*) AS windows
FROM (SELECT unnest(map_entries(figures)) AS figure FROM {WINDOWS_VIEW} WHERE accepted) GROUP BY ALL ORDER BY ALL""",
    "How long does a window take, by version?": f"""
SELECT versions['coec'] AS version, median(seconds) AS s, quantile_cont(seconds, 0.99) AS s_99, count(*) AS windows
FROM {WINDOWS_VIEW} WHERE error IS NULL GROUP BY ALL ORDER BY ALL""",
}
"""Example queries, by the question that each answers."""


def connect(folder: Path) -> Any:
    """A connection (`duckdb.DuckDBPyConnection`) with the view `windows` over the tables of a batch.

    Raises:
        UsageError: there are no tables.
        SourceError: the optional extra is not installed.
    """
    connection = optional_library("duckdb").connect(":memory:", config={"autoinstall_known_extensions": "false"})
    create_view(connection, WINDOWS_VIEW, folder)
    return connection


def create_view(connection: Any, name: str, folder: Path) -> None:
    """Creates a view over the tables of another batch.

    Raises:
        UsageError: there are no tables.
    """
    if next(folder.glob("date=*/vehicle=*/*.parquet"), None) is None:
        raise UsageError(f"{folder} holds no tables of a batch (date=.../vehicle=.../*.parquet): coec batch makes them")
    connection.execute(view_statement(name, folder))


def view_statement(name: str, folder: Path) -> str:
    """SQL that creates a view over the tables of a batch. Names of vehicles stay text, even 007."""
    pattern = str(folder / "date=*" / "vehicle=*" / "*.parquet").replace("'", "''")
    return (
        f"CREATE VIEW {name} AS SELECT * FROM read_parquet('{pattern}', hive_partitioning = true, "
        "hive_types = {'date': VARCHAR, 'vehicle': VARCHAR})"
    )


def columns(folder: Path) -> list[tuple[str, str]]:
    """Name and type of every column.

    Raises:
        UsageError, SourceError: as `ask`.
    """
    described = connect(folder).execute(f"DESCRIBE {WINDOWS_VIEW}").fetchall()
    return [(str(name), str(kind)) for name, kind, *_ in described]
