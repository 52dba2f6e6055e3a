"""Answers to a workshop's tester: trouble codes and data over UDS (ISO 14229-1), by a process of its own."""
