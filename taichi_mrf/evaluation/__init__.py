"""How well a map explains what it has not seen: accuracy, ground truth, reliability, pictures.

Uses `mapping` and the packages below it.
"""
