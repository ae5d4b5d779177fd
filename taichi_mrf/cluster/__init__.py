"""Tasks in processes of their own: on this machine, or on those of a Dask cluster.

It does not depend on maps: a task is any value that can be pickled, with a function that can be imported.
"""
