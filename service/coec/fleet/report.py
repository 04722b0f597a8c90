"""The report on a fleet from many windows: drift of every pair, refusals and their reasons, false alarms, and
differences from another batch.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

from coec.calibration.baseline import poisson_most
from coec.fleet.tables import NAMELESS, WINDOWS_VIEW, connect, create_view
from coec.schemas import fleet
from coec.schemas.heartbeat import LastWord
from coec.schemas.replies import Alarms, Maybe6

S_PER_H = 3600.0

CONFIDENCE = 0.95
"""Confidence of the upper bound on the rate."""


def false_alarms(heartbeats: Iterable[LastWord]) -> fleet.FalseAlarms:
    """False alarms of all pairs together. Pairs whose word has no counts, because they are awaited, are left out."""
    counted = [
        (f"{heartbeat.vehicle}/{heartbeat.pair}", heartbeat.alarms)
        for heartbeat in heartbeats
        if heartbeat.alarms is not None
    ]
    watched_h = sum(alarms.watched_s for _, alarms in counted) / S_PER_H
    withdrawn = sum(alarms.withdrawn for _, alarms in counted)
    return fleet.FalseAlarms(
        pairs=len(counted),
        watched_h=watched_h,
        confirmed=sum(alarms.confirmed for _, alarms in counted),
        withdrawn=withdrawn,
        per_100_h=100.0 * withdrawn / watched_h if watched_h > 0.0 else None,
        per_100_h_at_most=100.0 * poisson_most(CONFIDENCE, withdrawn) / watched_h if watched_h > 0.0 else None,
        by_pair={name: alarms.withdrawn for name, alarms in sorted(counted, key=_most_first) if alarms.withdrawn},
    )


def _most_first(entry: tuple[str, Alarms]) -> tuple[int, str]:
    return -entry[1].withdrawn, entry[0]


REPORT_TABLE, EARLIER_VIEW = "read", "before"
"""Names of the table with the columns that a report needs, and of the view of the batch to compare with."""

WINDOWS_AT_END = 5
"""How many accepted windows at each end give, by their median, where a pair began and where it is now. A single outlier
moves neither."""

MONTH_S = 30 * 86_400.0

MAX_CHANGED_WINDOWS = 50
"""How many windows with a different decision are listed."""

NS_PER_S = 1e9

_OBSERVED_CORRECTIONS = ", ".join(
    f"CASE WHEN observed[{index}] THEN {axis} END AS {axis}" for index, axis in enumerate(fleet.AXES, 1)
)
"""The corrections; null for axes that a window does not observe."""

_REPORT_COLUMNS = (
    "vehicle, pair, date, stamp_ns, window_id, url, sha256, accepted, observed, reason_codes, error_code, decision,"
    f" figures, {', '.join(fleet.AXES)}"
)
"""Columns that a report needs. They are copied into a table, so that each of thousands of files is opened only once."""

_ACCEPTED = f"(SELECT vehicle, pair, date, stamp_ns, {_OBSERVED_CORRECTIONS} FROM {REPORT_TABLE} WHERE accepted)"


def report(folder: Path, against: Path | None, fleet_now: fleet.FleetNow | None = None) -> fleet.FleetReport:
    """The report from the tables in a folder. `against`: folder of an earlier batch over the same windows. `now`: the
    last words of the vehicles, for their alarms.

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
    return fleet.FleetReport(
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


def _pairs(connection: Any) -> tuple[fleet.PairOfFleet, ...]:
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
        shares = [0.0 if d is None else abs(d) / seen for d, seen in zip(drift, fleet.SEEN, strict=True)]
        urgency = max(shares)
        made.append(
            fleet.PairOfFleet(
                vehicle=vehicle,
                pair=pair or "",
                windows=windows,
                accepted=accepted,
                errors=errors,
                last_ns=last_ns,
                latest=latest,
                drift=_six(drift),
                slope=slope,
                worst=fleet.AXES[shares.index(urgency)] if urgency > 0.0 else None,
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
        f" regr_slope({axis}, stamp_ns / {NS_PER_S}) * {MONTH_S}"
        for axis in fleet.AXES
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


def _days(connection: Any) -> dict[tuple[str, str], list[fleet.DayOfPair]]:
    spread = ", ".join(f"quantile_cont({axis}, [0.16, 0.5, 0.84])" for axis in fleet.AXES)
    rows = connection.execute(
        f"SELECT vehicle, pair, date, count(*), {spread} FROM {_ACCEPTED} GROUP BY ALL ORDER BY vehicle, pair, date"
    ).fetchall()
    made: dict[tuple[str, str], list[fleet.DayOfPair]] = defaultdict(list)
    for vehicle, pair, date, windows, *spreads in rows:
        low, middle, high = zip(*(each or (None, None, None) for each in spreads), strict=True)
        day = fleet.DayOfPair(date=date, windows=windows, low=_six(low), middle=_six(middle), high=_six(high))
        made[vehicle, pair].append(day)
    return made


def _figures(connection: Any) -> tuple[fleet.FigureOfFleet, ...]:
    rows = connection.execute(
        "SELECT figure.key, pair, count(DISTINCT vehicle), count(*), quantile_cont(figure.value, [0.005, 0.5, 0.995])"
        f" FROM (SELECT vehicle, pair, unnest(map_entries(figures)) AS figure FROM {REPORT_TABLE} WHERE accepted)"
        " WHERE figure.value IS NOT NULL GROUP BY ALL ORDER BY ALL"
    ).fetchall()
    return tuple(
        fleet.FigureOfFleet(
            name=name, pair=pair, vehicles=vehicles, windows=windows, low=spread[0], middle=spread[1], high=spread[2]
        )
        for name, pair, vehicles, windows, spread in rows
    )


def _unique_windows(name: str) -> str:
    """The windows of a view; of several copies only the one with the first URL."""
    return f"(SELECT * FROM {name} QUALIFY row_number() OVER (PARTITION BY sha256 ORDER BY url) = 1)"


def _changes(connection: Any, against: Path) -> fleet.FleetChanges:
    create_view(connection, EARLIER_VIEW, against)
    rotation = "greatest(" + ", ".join(f"abs(now.{axis} - was.{axis})" for axis in fleet.AXES[:3]) + ")"
    translation = "greatest(" + ", ".join(f"abs(now.{axis} - was.{axis})" for axis in fleet.AXES[3:]) + ")"
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
    return fleet.FleetChanges(
        both=both,
        identical=identical,
        newly_accepted=gained,
        newly_refused=lost,
        newly_failing=failing,
        rotation_deg=rotation_deg,
        translation_m=translation_m,
        windows=tuple(
            fleet.ChangedWindow(
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
