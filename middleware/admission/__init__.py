"""Admission to closed teams: invitations, certificates, the membership list, renewal and revocation."""
