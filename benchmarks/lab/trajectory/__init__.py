"""How far a tracked camera drifts, how far loop closure takes that back, and what becomes of lost frames."""
