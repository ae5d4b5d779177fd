"""The pages in the browser, in a process of their own without a map.

`messages` is what the mapping process and a page send each other. `transport` is the guarded web server,
`scene` is what both pages share, `live` and `tune` are the pages. docs/floors.yaml has their order.
"""
