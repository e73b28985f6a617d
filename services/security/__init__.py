"""Who may enter, and what each may do there: roles, certificates, role files, and the proof that they hold."""
