"""Servos made ready for an experiment: held arms, settings kept and put back, what each servo must be like."""
