"""catkin hook: makes src/iwgnet_grasp importable from the devel space."""

from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import setup

setup(**generate_distutils_setup(packages=["iwgnet_grasp"], package_dir={"": "src"}))
