"""How fast, in detail: `python -m benchmarks.speed SOURCE --measure NAME`, from the root of the project."""
