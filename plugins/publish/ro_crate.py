"""RO-Crate 1.1 metadata of a publication: files with checksums, and their origin."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath

from sliplab.plugins.publish.publication import Publication, TrialPath, campaign_folder
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import PROTOCOL, RIG, Campaign

_CONTEXT = "https://w3id.org/ro/crate/1.1/context"
_KINDS = {
    ".h5": "application/x-hdf5",
    ".mkv": "video/x-matroska",
    ".json": "application/json",
    ".yaml": "application/yaml",
    ".mcap": "application/x-mcap",
    ".parquet": "application/x-parquet",
    ".npz": "application/zip",
    ".md": "text/markdown",
}


def ro_crate(
    publication: Publication,
    sums: Mapping[str, str],
    sizes: Mapping[str, int],
    data: TrialPath,
) -> Json:
    """Return the content of ``ro-crate-metadata.json``.

    Args:
        sums: SHA-256 of every file, by its path in the publication.
        sizes: bytes of each.
        data: gives the path of a trial's data.
    """
    about = publication.about
    people = [
        {"@id": f"#creator-{n}", "@type": "Person", "name": name}
        for n, name in enumerate(about.creators, 1)
    ]
    programs = [
        {
            "@id": f"#sliplab-{version}",
            "@type": "SoftwareApplication",
            "name": "SlipLab",
            "version": version,
        }
        for version in publication.versions.get("sliplab", ())
    ]
    used = [item["@id"] for item in programs]
    runs = [_run(campaign, used, data) for campaign in publication.campaigns]
    files = [
        {
            "@id": name,
            "@type": "File",
            "name": PurePosixPath(name).name,
            "contentSize": str(sizes[name]),
            "encodingFormat": _KINDS.get(PurePosixPath(name).suffix, "application/octet-stream"),
            "sha256": digest,
        }
        for name, digest in sorted(sums.items())
    ]
    root: Json = {
        "@id": "./",
        "@type": "Dataset",
        "name": about.title,
        "description": publication.description,
        "datePublished": about.date,
        "hasPart": [{"@id": item["@id"]} for item in files],
        "mentions": [{"@id": item["@id"]} for item in runs],
    }
    if people:
        root["creator"] = [{"@id": item["@id"]} for item in people]
    licences: list[Json] = []
    if about.licence is not None:
        known = about.licence_url or f"#{about.licence}"
        root["license"] = {"@id": known}
        licences = [{"@id": known, "@type": "CreativeWork", "name": about.licence}]
    descriptor = {
        "@id": "ro-crate-metadata.json",
        "@type": "CreativeWork",
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
        "about": {"@id": "./"},
    }
    # the context of 1.1 is older than schema.org's word for this
    context = [_CONTEXT, {"sha256": "https://schema.org/sha256"}]
    graph = [descriptor, root, *people, *licences, *programs, *runs, *files]
    return {"@context": context, "@graph": graph}


def _run(campaign: Campaign, programs: list[str], data: TrialPath) -> Json:
    """Describe how a campaign's trials were made: by which program, protocol and rig."""
    folder = campaign_folder(campaign.name)
    simulated = " (simulated)" if campaign.info["simulated"] else ""
    return {
        "@id": f"#collection-{campaign.name}",
        "@type": "CreateAction",
        "name": f"collection of {campaign.name}{simulated}",
        "instrument": [{"@id": name} for name in programs],
        "object": [{"@id": f"{folder}/{name}"} for name in (PROTOCOL, RIG)],
        "result": [{"@id": data(campaign.name, trial)} for trial in sorted(campaign.committed())],
    }
