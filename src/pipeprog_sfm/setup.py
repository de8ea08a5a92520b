# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "pipeprog_sfm"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},  # by which colcon test knows what to run
    zip_safe=False,
    maintainer="pipeprog developers",
    maintainer_email="maintainers@pipeprog.dev",
    description="Incremental metric structure from motion and a dense cloud from keyframes, and their node.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["sfm_node = pipeprog_sfm.node:main"]},
)
