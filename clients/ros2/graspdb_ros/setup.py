from setuptools import setup

setup(
    name="graspdb_ros",
    version="0.1.0",
    packages=["graspdb_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/graspdb_ros"]),
        ("share/graspdb_ros", ["package.xml"]),
    ],
    install_requires=["setuptools", "graspdb"],
    zip_safe=True,
    license="Apache-2.0",
    entry_points={"console_scripts": ["grasps = graspdb_ros.node:main"]},
)
