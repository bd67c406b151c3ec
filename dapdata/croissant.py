"""The dataset's Croissant description (JSON-LD): what search engines and loaders of the format read.

Two record sets can be loaded by it: `demos`, the rows of the index, and `arrays`, the table of what a shard holds. The
shards themselves are a set of files without records: Croissant's readers know no Zarr.

Nothing in it but what follows from the manifest and the index; hence no date of publication, which its validators
recommend: whoever publishes the dataset adds it.

Source: Croissant format specification 1.0, MLCommons.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dapdata import card, durable
from dapdata.records import is_ragged
from dapdata.tables import Index

CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
INDEX, SHARDS = "index.parquet", "shards"
SENTENCES = {  # columns of the index whose name does not say it all
    "demo": "index of the demo in the dataset",
    "split": "train, val or test; unused: shares an instance with two of them",
    "shard": "path of the Zarr group that holds the demo",
    "row": "number of the demo in its shard",
    "task": "name of the task",
    "sha256": "digest of the demo's decoded arrays",
    "container_instance": "digest of the geometry of container and clutter",
    "object_instance": "digest of the object's geometry",
    "attempts": "scenes drawn until this one was accepted",
}
ABOUT_ARRAYS = ("path", "dtype", "shape", "unit", "frame", "description", "codes")


def render(manifest: Mapping[str, Any], folders: Sequence[str], index: Index) -> bytes:
    """The description as JSON.

    Args:
        manifest: As JSON data, of a labelled dataset; its shards and stages are not looked at.
        folders: Where the shards are.
        index: Of all demos; its columns are not read.
    """
    about = card.origin(manifest)
    how, of_type, personal = about.collection
    tree = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": manifest["name"],
        "description": card.summary(manifest, index.rows, index.rows),
        **({"license": about.license_url} if about.license_url else {}),
        "citeAs": card.citation(manifest),
        "creator": {"@type": "sc:Organization", "name": "dapdata"},
        "keywords": [*card.TAGS, *about.tags, manifest["task"]],
        "version": f"{manifest['format']}.0.0+{manifest['content_sha256'][:12]}",
        "rai:dataCollection": how,
        "rai:dataCollectionType": of_type,
        "rai:dataLimitation": " ".join(about.limits.split()) + " One object; containers do not move.",
        "rai:personalSensitiveInformation": personal,
        "distribution": _distribution(folders, index.path),
        "recordSet": [_demos(index), _arrays(manifest)],
    }
    return json.dumps(tree, indent=1, ensure_ascii=False).encode() + b"\n"


def _distribution(folders: Sequence[str], index_file: Path) -> list[dict[str, Any]]:
    return [
        {
            "@type": "cr:FileObject",
            "@id": INDEX,
            "name": INDEX,
            "description": "One row per demo: where it is, its split, instances and counts.",
            "contentUrl": INDEX,
            "contentSize": f"{index_file.stat().st_size} B",
            "encodingFormat": "application/x-parquet",
            "sha256": durable.hash_file(index_file),
        },
        {
            "@type": "cr:FileSet",
            "@id": SHARDS,
            "name": SHARDS,
            "description": "Zarr v3 groups; manifest.json names each with its sha256.",
            "encodingFormat": "application/vnd.zarr",
            "includes": [f"{folder}/**" for folder in folders],
        },
    ]


def _demos(index: Index) -> dict[str, Any]:
    """The index as a record set."""
    fields = [
        {
            "@type": "cr:Field",
            "@id": f"demos/{name}",
            "name": name,
            "description": SENTENCES.get(name, name.replace("_", " ")),
            "dataType": "sc:Integer" if name in index.numbers else "sc:Text",
            "source": {"fileObject": {"@id": INDEX}, "extract": {"column": name}},
        }
        for name in index
    ]
    return {"@type": "cr:RecordSet", "@id": "demos", "name": "demos", "key": {"@id": "demos/demo"}, "field": fields}


def _arrays(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The table of arrays as a record set whose records stand in the description itself."""
    fields = [{"@type": "cr:Field", "@id": f"arrays/{name}", "name": name, "dataType": "sc:Text"} for name in ABOUT_ARRAYS]
    records = []
    for column in card.stored(manifest):
        about = column.metadata
        dims = about["dims"] if is_ragged(column) else about["dims"][1:]
        shape, codes = " x ".join(map(str, dims)), ", ".join(f"{i} {name}" for i, name in enumerate(about["names"]))
        record = {**about, "dtype": about["dtype"].lstrip("<|"), "shape": shape, "codes": codes}
        records.append({f"arrays/{name}": record[name] for name in ABOUT_ARRAYS})
    return {"@type": "cr:RecordSet", "@id": "arrays", "name": "arrays", "field": fields, "data": records}
