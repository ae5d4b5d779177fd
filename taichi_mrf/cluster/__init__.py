"""Tasks in processes of their own: on this machine, or on those of a Dask cluster.

Knows nothing of maps: a task is any value that can be pickled, and a function that can be imported.
"""
