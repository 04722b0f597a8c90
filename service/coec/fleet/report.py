"""The tables of a batch and the report on a fleet. Rows are written as Parquet files in folders by date and vehicle,
as DuckDB, Spark and pandas read them, and queried with SQL; the libraries for both are the optional extra `fleet`.
The report says the drift of every pair, refusals and their reasons, false alarms, and differences from another
batch.
"""

import io
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

from coec.calibration.baseline import poisson_most
from coec.calibration.types import NS_PER_S
from coec.errors import SourceError, UsageError
from coec.io import user_files
from coec.schemas import documents
from coec.schemas.heartbeat import LastWord
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
            *((axis, number) for axis in documents.AXES),
            *((f"sigma_{axis}", number) for axis in documents.AXES),
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


def write_tables(folder: Path, rows: Iterable[documents.WindowRow], name: str) -> None:
    """Writes a file of this name for each date and vehicle, each completely or not at all.

    Raises:
        OutputError: a file cannot be written.
    """
    groups: dict[str, list[documents.WindowRow]] = defaultdict(list)
    for row in rows:
        date = UNDATED if row.result is None else f"{_time(row.result.data_stamp_ns):%Y-%m-%d}"
        groups[f"date={date}/vehicle={quote(row.vehicle, safe='') or NAMELESS}"].append(row)
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


def _time(stamp_ns: int) -> datetime:
    return datetime.fromtimestamp(stamp_ns // NS_PER_S, UTC)


def _parquet(rows: Sequence[documents.WindowRow]) -> bytes:
    pa, parquet = optional_library("pyarrow"), optional_library("pyarrow.parquet")

    table = pa.Table.from_pylist([_row_values(row) for row in sorted(rows, key=lambda row: row.url)], table_schema())
    stream = io.BytesIO()
    parquet.write_table(table, stream, compression="zstd")
    return stream.getvalue()


_OF_ROW = {"url", "sha256", "bytes", "seconds", "cpu_s", "error_code", "error"}
_OF_RESULT = {
    *("window_id", "pair", "camera_frame", "lidar_frame", "pairs", "independent_looks", "score", "score_at_start"),
    *("mi", "overlap", "points_in_view", "evaluations", "stop_reason", "first_derivative", "second_derivative"),
    *("depth_identity", "config_hash"),
}
"""Columns that are fields of a row, or of its result, by the same name."""


def _row_values(row: documents.WindowRow) -> dict[str, Any]:
    """The values of a row. Maps are in the order of their names, so that equal rows give equal bytes, also in a resumed
    batch."""
    fields: dict[str, Any] = {
        **row.model_dump(include=_OF_ROW),
        "recorded_decision": row.recorded,
        "decision": row.decided,
        "versions": sorted(row.versions.items()),
    }
    result = row.result
    if result is None:
        return fields
    seen = zip(result.solved, result.unobservable, strict=True)
    return {
        **fields,
        **result.model_dump(include=_OF_RESULT),
        "stamp_ns": result.data_stamp_ns,
        "time": _time(result.data_stamp_ns),
        **dict(zip(documents.AXES, result.correction, strict=True)),
        **{f"sigma_{axis}": value for axis, value in zip(documents.AXES, result.sigma, strict=True)},
        "correlation": _correlation(result.noise),
        "camera_from_lidar": [value for line in result.camera_from_lidar.matrix for value in line],
        "observed": [solved and not blind for solved, blind in seen],
        "accepted": result.verdict.decision == "accepted",
        "reason_codes": [reason.code for reason in result.verdict.reasons],
        "reasons": [reason.text for reason in result.verdict.reasons],
        "figures": [(name, metric.value) for name, metric in sorted(result.metrics.items())],
        "limits": [(name, metric.limit) for name, metric in sorted(result.metrics.items())],
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
        UsageError, SourceError: as `connect`.
    """
    described = connect(folder).execute(f"DESCRIBE {WINDOWS_VIEW}").fetchall()
    return [(str(name), str(kind)) for name, kind, *_ in described]


# --- the report -------------------------------------------------------------------------------------------------------

S_PER_H = 3600.0

CONFIDENCE = 0.95
"""Confidence of the upper bound on the rate."""


def false_alarms(heartbeats: Iterable[LastWord]) -> documents.FalseAlarms:
    """False alarms of all pairs together. Pairs whose word has no counts, because they are awaited, are left out."""
    counted = [
        (f"{heartbeat.vehicle}/{heartbeat.pair}", heartbeat.alarms)
        for heartbeat in heartbeats
        if heartbeat.alarms is not None
    ]
    watched_h = sum(alarms.watched_s for _, alarms in counted) / S_PER_H
    withdrawn = sum(alarms.withdrawn for _, alarms in counted)
    most_first = sorted(counted, key=lambda entry: (-entry[1].withdrawn, entry[0]))
    return documents.FalseAlarms(
        pairs=len(counted),
        watched_h=watched_h,
        confirmed=sum(alarms.confirmed for _, alarms in counted),
        withdrawn=withdrawn,
        per_100_h=100.0 * withdrawn / watched_h if watched_h > 0.0 else None,
        per_100_h_at_most=100.0 * poisson_most(CONFIDENCE, withdrawn) / watched_h if watched_h > 0.0 else None,
        by_pair={name: alarms.withdrawn for name, alarms in most_first if alarms.withdrawn},
    )


REPORT_TABLE, EARLIER_VIEW = "read", "before"
"""Names of the table with the columns that a report needs, and of the view of the batch to compare with."""

WINDOWS_AT_END = 5
"""How many accepted windows at each end give, by their median, where a pair began and where it is now. A single outlier
moves neither."""

MONTH_S = 30 * 86_400.0

MAX_CHANGED_WINDOWS = 50
"""How many windows with a different decision are listed."""


_OBSERVED_CORRECTIONS = ", ".join(
    f"CASE WHEN observed[{index}] THEN {axis} END AS {axis}" for index, axis in enumerate(documents.AXES, 1)
)
"""The corrections; null for axes that a window does not observe."""

_REPORT_COLUMNS = (
    "vehicle, pair, date, stamp_ns, window_id, url, sha256, accepted, observed, reason_codes, error_code, decision,"
    f" figures, {', '.join(documents.AXES)}"
)
"""Columns that a report needs. They are copied into a table, so that each of thousands of files is opened only once."""

_ACCEPTED = f"(SELECT vehicle, pair, date, stamp_ns, {_OBSERVED_CORRECTIONS} FROM {REPORT_TABLE} WHERE accepted)"


def report(folder: Path, against: Path | None, fleet_now: documents.FleetNow | None = None) -> documents.FleetReport:
    """The report from the tables in a folder. `against`: folder of an earlier batch over the same windows. `fleet_now`:
    the last words of the vehicles, for their alarms.

    Raises:
        UsageError: there are no tables.
        SourceError: the optional extra is not installed.
    """
    connection = connect(folder)
    connection.execute(f"CREATE TEMP TABLE {REPORT_TABLE} AS SELECT {_REPORT_COLUMNS} FROM {WINDOWS_VIEW}")
    windows, accepted, first_ns, last_ns = connection.execute(
        f"SELECT count(*), count(*) FILTER (accepted), min(stamp_ns), max(stamp_ns) FROM {REPORT_TABLE}"
    ).fetchone()
    pairs = _pairs(connection)
    return documents.FleetReport(
        vehicles=len({pair.vehicle for pair in pairs} - {NAMELESS}),
        pairs=pairs,
        windows=windows,
        accepted=accepted,
        refusals=_counts(connection, f"SELECT unnest(reason_codes) AS code FROM {REPORT_TABLE} WHERE NOT accepted"),
        errors=_counts(connection, f"SELECT error_code AS code FROM {REPORT_TABLE} WHERE error_code IS NOT NULL"),
        first_ns=first_ns,
        last_ns=last_ns,
        figures=_figures(connection),
        changes=None if against is None else _changes(connection, against),
        false_alarms=None if fleet_now is None else false_alarms(pair.word for pair in fleet_now.pairs),
    )


def _counts(connection: Any, codes: str) -> dict[str, int]:
    return dict(connection.execute(f"SELECT code, count(*) FROM ({codes}) GROUP BY ALL ORDER BY ALL").fetchall())


def _pairs(connection: Any) -> tuple[documents.PairOfFleet, ...]:
    days = _days(connection)
    ends = _ends(connection)
    counted = connection.execute(
        f"SELECT vehicle, pair, count(*), count(*) FILTER (accepted), count(*) FILTER (error_code IS NOT NULL),"
        f" max(stamp_ns) FROM {REPORT_TABLE} GROUP BY ALL"
    ).fetchall()
    made = []
    for vehicle, pair, windows, accepted, errors, last_ns in counted:
        first, latest, slope = ends.get((vehicle, pair), (_UNKNOWN, _UNKNOWN, _UNKNOWN))
        drift = [None if a is None or b is None else b - a for a, b in zip(first, latest, strict=True)]
        shares = [0.0 if d is None else abs(d) / seen for d, seen in zip(drift, documents.SEEN, strict=True)]
        urgency = max(shares)
        made.append(
            documents.PairOfFleet(
                vehicle=vehicle,
                pair=pair or "",
                windows=windows,
                accepted=accepted,
                errors=errors,
                last_ns=last_ns,
                latest=latest,
                drift=_six(drift),
                slope=slope,
                worst=documents.AXES[shares.index(urgency)] if urgency > 0.0 else None,
                urgency=urgency,
                days=tuple(days[vehicle, pair]),
            )
        )
    return tuple(sorted(made, key=lambda pair: (-pair.urgency, pair.vehicle, pair.pair)))


_UNKNOWN: Maybe6 = (None,) * 6


def _six(values: Sequence[float | None]) -> Maybe6:
    return cast("Maybe6", tuple(values))


def _ends(connection: Any) -> dict[tuple[str, str], tuple[Maybe6, Maybe6, Maybe6]]:
    """By vehicle and pair: medians of the first and of the last accepted windows, and the slope over all, per month."""
    medians = ", ".join(
        f"median({axis}) FILTER (up <= {WINDOWS_AT_END}), median({axis}) FILTER (down <= {WINDOWS_AT_END}),"
        f" regr_slope({axis}, stamp_ns / {float(NS_PER_S)}) * {MONTH_S}"
        for axis in documents.AXES
    )
    # Windows are ranked once for all axes, because ranking each axis by itself would take eighteen sorts. Nearly all
    # windows of a pair observe the same axes.
    rows = connection.execute(
        f"SELECT vehicle, pair, count(DISTINCT date) > 1, {medians} FROM (SELECT *,"
        " row_number() OVER (PARTITION BY vehicle, pair ORDER BY stamp_ns) AS up,"
        " row_number() OVER (PARTITION BY vehicle, pair ORDER BY stamp_ns DESC) AS down"
        f" FROM {_ACCEPTED}) GROUP BY ALL"
    ).fetchall()
    return {
        (vehicle, pair): (
            _six(values[0::3]),
            _six(values[1::3]),
            _six(values[2::3]) if several_days else _UNKNOWN,
        )
        for vehicle, pair, several_days, *values in rows
    }


def _days(connection: Any) -> dict[tuple[str, str], list[documents.DayOfPair]]:
    spread = ", ".join(f"quantile_cont({axis}, [0.16, 0.5, 0.84])" for axis in documents.AXES)
    rows = connection.execute(
        f"SELECT vehicle, pair, date, count(*), {spread} FROM {_ACCEPTED} GROUP BY ALL ORDER BY vehicle, pair, date"
    ).fetchall()
    made: dict[tuple[str, str], list[documents.DayOfPair]] = defaultdict(list)
    for vehicle, pair, date, windows, *spreads in rows:
        low, middle, high = zip(*(each or (None, None, None) for each in spreads), strict=True)
        day = documents.DayOfPair(date=date, windows=windows, low=_six(low), middle=_six(middle), high=_six(high))
        made[vehicle, pair].append(day)
    return made


def _figures(connection: Any) -> tuple[documents.FigureOfFleet, ...]:
    rows = connection.execute(
        "SELECT figure.key, pair, count(DISTINCT vehicle), count(*), quantile_cont(figure.value, [0.005, 0.5, 0.995])"
        f" FROM (SELECT vehicle, pair, unnest(map_entries(figures)) AS figure FROM {REPORT_TABLE} WHERE accepted)"
        " WHERE figure.value IS NOT NULL GROUP BY ALL ORDER BY ALL"
    ).fetchall()
    return tuple(
        documents.FigureOfFleet(
            name=name, pair=pair, vehicles=vehicles, windows=windows, low=spread[0], middle=spread[1], high=spread[2]
        )
        for name, pair, vehicles, windows, spread in rows
    )


def _unique_windows(name: str) -> str:
    """The windows of a view; of several copies only the one with the first URL."""
    return f"(SELECT * FROM {name} QUALIFY row_number() OVER (PARTITION BY sha256 ORDER BY url) = 1)"


def _changes(connection: Any, against: Path) -> documents.FleetChanges:
    create_view(connection, EARLIER_VIEW, against)
    rotation = "greatest(" + ", ".join(f"abs(now.{axis} - was.{axis})" for axis in documents.AXES[:3]) + ")"
    translation = "greatest(" + ", ".join(f"abs(now.{axis} - was.{axis})" for axis in documents.AXES[3:]) + ")"
    connection.execute(
        "CREATE TEMP TABLE changed AS SELECT now.vehicle, coalesce(now.window_id, was.window_id, now.url) AS window_id,"
        " coalesce(now.decision = was.decision, now.error_code = was.error_code, false) AS same,"
        " coalesce(was.accepted, false) AS was_accepted, coalesce(now.accepted, false) AS now_accepted,"
        " was.error_code IS NULL AND now.error_code IS NOT NULL AS failing,"
        " coalesce(was.error_code, array_to_string(was.reason_codes, ', ')) AS was_why,"
        " coalesce(now.error_code, array_to_string(now.reason_codes, ', ')) AS now_why,"
        f" {rotation} AS rotation, {translation} AS translation"
        f" FROM {_unique_windows(REPORT_TABLE)} AS now JOIN {_unique_windows(EARLIER_VIEW)} AS was USING (sha256)"
    )
    both, identical, gained, lost, failing, rotation_deg, translation_m = connection.execute(
        "SELECT count(*), count(*) FILTER (same), count(*) FILTER (now_accepted AND NOT was_accepted),"
        " count(*) FILTER (was_accepted AND NOT now_accepted), count(*) FILTER (failing),"
        " sqrt(avg(rotation ** 2) FILTER (was_accepted AND now_accepted)),"
        " sqrt(avg(translation ** 2) FILTER (was_accepted AND now_accepted)) FROM changed"
    ).fetchone()
    rows = connection.execute(
        "SELECT vehicle, window_id, was_accepted, was_why, now_accepted, now_why, rotation, translation FROM changed"
        " WHERE was_accepted <> now_accepted OR failing"
        f" ORDER BY rotation DESC NULLS LAST, vehicle, window_id LIMIT {MAX_CHANGED_WINDOWS}"
    ).fetchall()
    return documents.FleetChanges(
        both=both,
        identical=identical,
        newly_accepted=gained,
        newly_refused=lost,
        newly_failing=failing,
        rotation_deg=rotation_deg,
        translation_m=translation_m,
        windows=tuple(
            documents.ChangedWindow(
                vehicle=vehicle,
                window_id=window_id,
                before="accepted" if was_accepted else was_why,
                now="accepted" if now_accepted else now_why,
                rotation_deg=rotation_deg,
                translation_m=translation_m,
            )
            for vehicle, window_id, was_accepted, was_why, now_accepted, now_why, rotation_deg, translation_m in rows
        ),
    )
