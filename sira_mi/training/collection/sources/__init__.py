"""Where heads come from: one module a source, each delivering `sira_mi.training.collection.subject.Subject`."""
