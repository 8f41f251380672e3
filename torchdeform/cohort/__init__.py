"""Many pairs from one YAML file, on one machine or a cluster."""
