# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

package_name = "pipeprog_bringup"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(),
    package_data={package_name: ["fleet/index.html", "report/web/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        (f"share/{package_name}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{package_name}/config", sorted(glob("config/*.yaml"))),
        (f"share/{package_name}/viewers", sorted(glob("viewers/*"))),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},  # by which colcon test knows what to run
    zip_safe=False,
    maintainer="pipeprog developers",
    maintainer_email="maintainers@pipeprog.dev",
    description="Launch files, parameter presets, the command pipeprog, replay of recordings and the progress report.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": ["pipeprog = pipeprog_bringup.cli:main", "survey_node = pipeprog_bringup.survey.node:main"]
    },
)
