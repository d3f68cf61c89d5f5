"""Where a work folder and results lie: a folder of this machine, or a prefix of a bucket that no machine shares.

A path that begins with `s3:` is a place in a bucket (`Path("s3://bucket/prefix")`); it joins, hashes and travels as any
other path. What is read there is brought into a cache of this process first (`here`), what is written goes up when it
is whole (`storage/whole.py`). For a folder of this machine every function here is one comparison and the plain call.
"""

from storage.place.files import (
    age_s,
    all_here,
    bring_file,
    bring_folder,
    held,
    here,
    is_file,
    is_remote,
    made_once,
    make_folder,
    names,
    put_folder,
    put_in_place,
    read_text,
    remove,
    remove_folder,
    scratch,
    sizes,
    touch,
    write_text,
    written,
    zarr_store,
)
from storage.place.lease import alone, try_alone

__all__ = [
    "age_s",
    "all_here",
    "bring_file",
    "bring_folder",
    "alone",
    "held",
    "here",
    "is_file",
    "is_remote",
    "made_once",
    "make_folder",
    "names",
    "put_folder",
    "put_in_place",
    "read_text",
    "remove",
    "remove_folder",
    "scratch",
    "sizes",
    "touch",
    "try_alone",
    "write_text",
    "written",
    "zarr_store",
]
