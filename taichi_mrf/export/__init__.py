"""Maps as files for other programs.

Uses `queries` and the packages below it. Knows no mapping method.
"""
