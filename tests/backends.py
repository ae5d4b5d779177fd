"""Print the backends that the test suite can run on here, the CPU first: one word each."""

from taichi_mrf import runtime

if __name__ == "__main__":
    print(*(status.name for status in reversed(runtime.backends()) if status.problem is None))
