"""Keeps every test run to itself: a ROS domain of its own, and no packets beyond this machine."""

import os

# Set on import, before any test module initialises ROS; processes that tests start inherit it.
# Domains up to 101 keep clear of the ports that Linux hands out to clients.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
