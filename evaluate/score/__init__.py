"""Scores of rollouts: tables, statistics, figures and a report from rows."""
