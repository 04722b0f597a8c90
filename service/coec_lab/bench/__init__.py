"""`coec bench`: measures how fast this machine is: the kernels against plain forms in the same run, the worker by
itself, and the daemon under the load of a vehicle.

Ratios compare the fastest of alternating runs in one process, so that other load on the machine cancels out as far as
possible. Processor time is that of one process alone; round trips and starts are wall-clock time.
"""

from coec.cli.options import Json


def bench(as_json: Json = False) -> int:
    """Measure the speed of kernels, solves and processes on this machine, next to plain forms in the same run."""
    from coec_lab.bench import report

    return report.run(as_json=as_json)
