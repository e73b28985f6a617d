"""Speed of the model beside torch, and the report of `make bench`."""
