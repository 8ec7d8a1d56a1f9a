"""Judges whether clouds and IMU samples are what a certain consumer can work with.

Pure: what was received goes in as plain values (:mod:`.observation`), findings come out
(:mod:`.report`). What each consumer requires is a table (:mod:`.requirements`).
"""
