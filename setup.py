"""What pyproject.toml cannot say: the wheel holds the folder configs/ as the package taichi_mrf.configs."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["taichi_mrf", "taichi_mrf.*"]), "taichi_mrf.configs"],
    package_dir={"taichi_mrf.configs": "configs"},
    package_data={"taichi_mrf": ["py.typed"], "taichi_mrf.configs": ["*.yaml"]},
)
