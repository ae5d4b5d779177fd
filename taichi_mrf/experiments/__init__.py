"""The papers' evaluations, each from one call: scenes, contenders, scores, tables and pictures."""
