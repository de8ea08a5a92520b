# SPDX-License-Identifier: Apache-2.0
"""Surveys on a robot: an action that films, lets the graph finish and writes the results folder."""
