"""What a VRM file says about the model and what others may do with it, with cautious defaults.

Source: VRM Consortium, VRMC_vrm 1.0, meta.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

from snarfcli.checks import check_choice
from snarfcli.errors import UserError

__all__ = ["LICENSE_URL", "VrmMeta", "check_meta", "meta_object"]

log = logging.getLogger(__name__)

LICENSE_URL = "https://vrm.dev/licenses/1.0/"
"""The only licence document of VRM 1.0; the other fields are its conditions."""

_CHOICES = {
    "avatar_permission": ("onlyAuthor", "onlySeparatelyLicensedPerson", "everyone"),
    "commercial_usage": ("personalNonProfit", "personalProfit", "corporation"),
    "credit_notation": ("required", "unnecessary"),
    "modification": ("prohibited", "allowModification", "allowModificationRedistribution"),
}
_SPECIAL = {
    "violent_usage": "allowExcessivelyViolentUsage",
    "sexual_usage": "allowExcessivelySexualUsage",
    "political_or_religious_usage": "allowPoliticalOrReligiousUsage",
    "antisocial_or_hate_usage": "allowAntisocialOrHateUsage",
    "redistribution": "allowRedistribution",
}


@dataclass
class VrmMeta:
    """Model information and conditions of use of a VRM file; everything is forbidden that the format can forbid."""

    name: str | None = None
    """Name of the model; null for the subject."""
    version: str | None = None
    """Version of the model."""
    authors: list[str] = field(default_factory=list)
    """Authors of the model, the creator first; the format needs one: without any, `unknown` is written."""
    copyright: str | None = None
    """Copyright holder of the model."""
    contact: str | None = None
    """How to reach the authors."""
    references: list[str] = field(default_factory=list)
    """Works that the model is derived from."""
    third_party_licenses: str | None = None
    """Licences of parts of the model, such as that of the body model."""
    other_license_url: str | None = None
    """Address of a further licence."""
    avatar_permission: str = "onlyAuthor"
    """Who may act as the avatar: onlyAuthor, onlySeparatelyLicensedPerson or everyone."""
    violent_usage: bool = False
    """Allow excessively violent content."""
    sexual_usage: bool = False
    """Allow excessively sexual content."""
    political_or_religious_usage: bool = False
    """Allow political or religious purposes."""
    antisocial_or_hate_usage: bool = False
    """Allow antisocial content or hate speech."""
    commercial_usage: str = "personalNonProfit"
    """Commercial use: personalNonProfit, personalProfit or corporation."""
    credit_notation: str = "required"
    """Whether users must show the credit: required or unnecessary."""
    redistribution: bool = False
    """Allow redistribution."""
    modification: str = "prohibited"
    """Modification: prohibited, allowModification or allowModificationRedistribution."""


def check_meta(meta: VrmMeta) -> None:
    """Check the choices of the model information.

    Raises:
        UserError: a field has a value that the format does not know, or an author has no name.
    """
    for name, choices in _CHOICES.items():
        check_choice(f"vrm.{name}", getattr(meta, name), choices)
    if any(not author.strip() for author in meta.authors):
        raise UserError("vrm.authors: wanted names, got an empty one; give vrm.authors=[NAME]")


def meta_object(meta: VrmMeta, name: str) -> dict[str, Any]:
    """Return the `meta` object of the extension.

    Args:
        meta: the model information.
        name: name of the model if it has none.
    """
    if not meta.authors:
        log.info("the authors of the model are unknown; give vrm.authors=[NAME]")
    texts = {
        "version": meta.version,
        "copyrightInformation": meta.copyright,
        "contactInformation": meta.contact,
        "thirdPartyLicenses": meta.third_party_licenses,
        "otherLicenseUrl": meta.other_license_url,
    }
    content: dict[str, Any] = {"name": meta.name or name, "authors": meta.authors or ["unknown"], "licenseUrl": LICENSE_URL}
    content |= {key: text for key, text in texts.items() if text}
    if meta.references:
        content["references"] = meta.references
    content |= {key: getattr(meta, own) for own, key in _SPECIAL.items()}
    content["avatarPermission"] = meta.avatar_permission
    content["commercialUsage"] = meta.commercial_usage
    content["creditNotation"] = meta.credit_notation
    content["modification"] = meta.modification
    return content
