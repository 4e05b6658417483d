"""The laboratory in software: it answers on the wire and the bus as hardware would."""
