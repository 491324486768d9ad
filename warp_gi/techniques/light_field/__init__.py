"""Light field probes (light_field_probes.txt)."""
