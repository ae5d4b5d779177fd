"""The page in the browser, a process of its own that knows no map.

`transport` is the guarded web server, `scene` what is drawn in 3D, `live` and `tune` the two pages.
"""
