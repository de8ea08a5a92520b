# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "pipeprog_detect"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(),
    package_data={package_name: ["look/material_model.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},  # by which colcon test knows what to run
    zip_safe=False,
    maintainer="pipeprog developers",
    maintainer_email="maintainers@pipeprog.dev",
    description="Pipes in a metric cloud: cylinders, lengths, classes of the bill of quantities, and their node.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["detect_node = pipeprog_detect.node:main"]},
)
