"""The start screen: patients, last sessions, and the import of a patient by clicks."""
