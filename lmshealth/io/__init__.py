"""Readers: from files of any registered format to `Log`, in SI units, or a reason why not.

`read_log` raises nothing but ``BadLog`` for whatever a file holds. Its reasons:

=================== ==============================================================================
``missing-file``    nothing there, no regular file, or no right to open it
``empty``           0 bytes, or fewer than two samples
``format``          unknown suffix, content of another format, or a library not installed
``corrupt``         truncated or damaged
``too-large``       would swell to an unreasonable size when unpacked
``escapes``         samples or links outside the file or the folder
``columns``         a needed column is absent, doubled, not numeric or of another length
``unit``            a signal's unit is absent, unknown or of another quantity
``metadata``        a value that cannot be what its key says, or a key that is needed
``time``            no sample rate, two that disagree, time stamps out of order or not uniform
``no-signal``       no usable channel of Δe or acceleration is left
``bad-row``         what a manifest says of the log is no row of a table, or two that differ
=================== ==============================================================================

``Log.refused`` lists channels that were left out (``flat``, ``clipped``, ``missing-samples``, and
``time`` for a sample rate of its own) and stretches that were (``gaps``: the channel itself is
used, around them).

`read_manifest` and `find_logs` list under the same reasons what else cannot be used; a row that
names no log is told under the name of its table, reason ``bad-row``.

pandas, scipy, h5py, pyarrow, npTDMS and pyuff are imported when the first file needs them.
"""
