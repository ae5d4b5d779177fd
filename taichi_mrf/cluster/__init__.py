"""Tasks in processes of their own: on this machine, or on those of a Dask cluster.

Begin with ``runner.py``, the interface that ``local.py`` and ``dask_tasks.py`` fill. A task is any value that
can be pickled, with a function that can be imported; they know nothing of maps. ``submaps`` has maps larger
than one machine, as such tasks.
"""
