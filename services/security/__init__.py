"""Access to robots: certificates, role files, access control, and attacks that test them."""
