"""Cohorts: many pairs from one YAML file, each isolated from the others, resumable, on one machine or a cluster."""
