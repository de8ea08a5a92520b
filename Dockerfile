# pipeprog on a stock ROS 2 Jazzy (Ubuntu 24.04, Python 3.12): builds the workspace with colcon and runs its tests.
#   docker build -t pipeprog .                       build
#   docker run --rm pipeprog colcon test ...         see CONTRIBUTING.md
FROM ros:jazzy

RUN apt-get update && apt-get install -y --no-install-recommends python3-venv \
        libgl1 libegl1 libegl-mesa0 libgl1-mesa-dri libx11-6 libgomp1 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /workspace
COPY . .

# ROS packages by rosdep; then Python packages in the tested versions into an environment that sees those of ROS, for
# Ubuntu lets pip write into no other.
RUN apt-get update && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src --ignore-src -y --rosdistro jazzy \
    && rm -rf /var/lib/apt/lists/* \
    && python3 -m venv --system-site-packages /opt/pipeprog \
    && touch /opt/pipeprog/COLCON_IGNORE \
    && /opt/pipeprog/bin/pip install --no-cache-dir -r requirements.txt -r requirements-dev.txt
ENV PATH=/opt/pipeprog/bin:$PATH

# colcon with the interpreter of that environment, so that the nodes' scripts start with it.
RUN . /opt/ros/jazzy/setup.sh && python3 -m colcon build --base-paths src

ENTRYPOINT ["/workspace/setup/in_workspace.sh"]
CMD ["bash"]
