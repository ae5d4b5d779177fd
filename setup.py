"""What pyproject.toml cannot say: the wheel has the folders apps/ and configs/ as packages of taichi_mrf."""

from setuptools import find_packages, setup

FOLDERS = {"taichi_mrf.apps": "apps", "taichi_mrf.configs": "configs"}

setup(
    packages=sorted({*find_packages(include=["taichi_mrf", "taichi_mrf.*"]), *FOLDERS}),
    package_dir=FOLDERS,
    package_data={"taichi_mrf": ["py.typed"], "taichi_mrf.configs": ["*.yaml"]},
)
