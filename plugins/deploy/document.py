"""Documents of an exported network: `NAME.speck.json` and `NAME.card.json`."""

from __future__ import annotations

from typing import Annotated

from pydantic import PlainSerializer

from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows
from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import (
    Accuracy,
    Classification,
    CountChange,
    Latencies,
)

_whole = PlainSerializer(lambda settings: settings.model_dump(mode="json"))
"""All settings, the defaults too."""


class WindowCost(Part):
    """Means over windows, by layer; the last of each sum is `all`."""

    windows: Int
    events_a_window: Number
    rates: dict[str, Number]
    """Spikes per neuron and step."""
    synaptic_operations: dict[str, Number]
    dense_multiply_adds: dict[str, Int]
    """Without looking at zeros."""
    share_of_dense: Number
    footprint_bytes: Int | None = None
    connection_sparsity: Number | None = None
    activation_sparsity: Number | None = None
    """These three: see `storage.schema.evaluation.WindowWork`."""


class ModelFile(Part):
    """The exported model file."""

    file: str
    sha256: str


class PlacedLayer(Part):
    """A layer of weights and the neurons behind it on the chip; memories in words."""

    name: str
    in_channels: Int
    in_side: Int
    out_channels: Int
    out_side: Int
    kernel: Int
    stride: Int
    padding: Int
    weights: Int
    neurons: Int
    kernel_words: Int
    neuron_words: Int
    fan_in: Int
    fan_out: Int
    core: Int | None
    """Number of its core; null where the network does not fit, likewise its memories."""
    core_kernel_words: Int | None
    core_neuron_words: Int | None
    destinations: tuple[Int, ...]
    """Cores that it sends to."""


class ChipCore(Part):
    """One core of the chip; memories in words."""

    number: Int
    kernel_words: Int
    neuron_words: Int


class ChipLimits(Part):
    """Limits of the chip."""

    cores: tuple[ChipCore, ...]
    kernel: Int
    features: Int
    input_side: Int
    output_side: Int
    padding: Int
    strides: tuple[Int, ...]
    destinations_of_a_core: Int
    weight_bits: Int
    state_bits: Int


class ChipFit(Part):
    """The network's layers on the chip, or why they do not fit."""

    fits: Bool
    problems: tuple[str, ...]
    layers: tuple[PlacedLayer, ...]
    limits: ChipLimits


class QuantisedLayer(Part):
    """A layer with 8-bit weights."""

    scale: Number
    threshold: Int
    rounding: Number
    """RMS of the rounding errors, as a share of the RMS of the weights."""
    potential: tuple[Number, Number]
    """Lowest and highest before saturation."""
    saturated: Number
    """Share of the potentials that were cut off."""


class Quantisation(Part):
    """Effects of 8-bit weights; accuracies by `real` and `whole`."""

    layers: dict[str, QuantisedLayer]
    change: CountChange
    accuracy: dict[str, Accuracy]


class SpeckDescription(Document):
    """A network on a Speck chip; latencies by `real` and `whole`."""

    format: str
    simulated: Bool
    model: ModelFile
    fit: ChipFit
    quantisation: Quantisation
    detection: dict[str, Latencies]


class CardModel(ModelFile):
    """The model of a card, with its settings."""

    seed: Int
    parameters: Int
    network: Annotated[NetworkSettings, _whole]
    windows: Annotated[Windows, _whole]
    training: Annotated[Training, _whole]
    epochs: Int
    chosen_epoch: Int
    rates_in_training: dict[str, Number]


class CardCampaign(Part):
    """A campaign whose trials the figures are of."""

    name: str
    experiment: str
    protocol: str
    collection_hash: str
    analysis_hash: str
    rig: str
    simulated: Bool
    trials: dict[str, Int]
    """By part of the split."""


class CardData(Part):
    """The data that the figures are of."""

    store: str
    simulated: Bool
    made_from_these_data: Bool
    """`train` would make this model of them now."""
    campaigns: tuple[CardCampaign, ...]


class SplitFigures(Classification):
    """Figures of the windows of one part of the split."""

    trials: Int
    samples: Int


class ModelCard(Document):
    """A model, its training data and its accuracy."""

    format: str
    simulated: Bool
    model: CardModel
    data: CardData
    figures: dict[str, SplitFigures]
    """By part of the split."""
    margin: Number
    """Of the margin accuracy, mean spikes."""
    activity: WindowCost
    detection: Latencies
    versions: dict[str, str]
    warnings: tuple[str, ...]
