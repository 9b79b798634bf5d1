"""The ways in which conditions reach the actions: UCA-Flow's and its two ablations (paper section 4.2)."""

from lerobot_uca.networks.adaln import AdaLNTransformer
from lerobot_uca.networks.cross_attention import CrossAttentionTransformer
from lerobot_uca.networks.transformer import ConditionActionTransformer, UnifiedTransformer

CONDITIONING: dict[str, type[ConditionActionTransformer]] = {
    "unified": UnifiedTransformer,
    "cross_attention": CrossAttentionTransformer,
    "adaln": AdaLNTransformer,
}
