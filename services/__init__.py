"""The processes: hardware service, body schema service, recorder, clients and the command line."""
