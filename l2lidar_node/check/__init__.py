"""Checks whether a consumer can work with given clouds and IMU samples.

Pure: what was received goes in as plain values (:mod:`.observation`), findings come out
(:mod:`.report`). What each consumer requires is a table (:mod:`.requirements`).
"""
