"""The suite ``path``: whole pictures beside Mitsuba, first frames, memory."""
