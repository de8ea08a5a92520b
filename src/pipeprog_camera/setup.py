# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "pipeprog_camera"

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
    description="What pipeprog's packages share: the calibrated camera and the error for what a user can mend.",
    license="Apache-2.0",
)
