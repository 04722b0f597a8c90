"""Queries of the tables of a batch: one view, SQL, and example queries."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coec.errors import UsageError
from coec.fleet.extra import optional_library

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
