"""The networks that are trained: actor, critic, and an estimator that the actor reads.

An estimator is a part of the actor. Its encoder makes a latent of the policy's own observation, which should have a
history; the actor reads the latent beside the observation. No gradient of PPO's loss reaches the encoder: it learns a
latent of which a linear readout, the decoder, gives what the critic alone sees, such as velocity, heights of the feet
and the ground around. After DreamWaQ (Nahrendra et al., arXiv 2301.10602) and Ji et al. (arXiv 2202.05481).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor, create_mlp
from torch import Tensor, nn

from go1exp.config.schema.training import EstimatorConfig
from go1exp.sim.task import PPOConfig

ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh}


def has_bf16_units() -> bool:
    """Return whether this processor multiplies bfloat16 matrices in hardware (AVX-512 BF16 or AMX).

    Others emulate it: an update took eight times as long as in float32 on an AMD EPYC with AVX2.
    """
    checks = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")  # torch has no public name for them
    return any(getattr(torch.cpu, check, lambda: False)() for check in checks)


def policy_settings(
    config: PPOConfig,
    policy_size: int | None = None,
    estimator: EstimatorConfig | None = None,
    critic_widths: Sequence[int] = (),
) -> dict[str, Any]:
    """Return the keyword arguments of ``GaussianPolicy`` that a configuration stands for."""
    return {
        "net_arch": {"pi": list(config.hidden), "vf": list(config.hidden)},
        "activation_fn": ACTIVATIONS[config.activation],
        "ortho_init": config.orthogonal_init,
        "log_std_init": float(np.log(config.init_std)),
        "bf16": config.matmul_precision == "bf16" or (config.matmul_precision == "auto" and has_bf16_units()),
        "policy_size": policy_size,
        "estimator": estimator or EstimatorConfig(),
        "critic_widths": tuple(critic_widths),
    }


class EstimatingActor(nn.Module):
    """An actor that reads its observation and the latent that its encoder makes of it.

    Args:
        net: from observation and latent (N, P + L) to SB3's latent of the actor.
        encoder: from observation (N, P) to latent (N, L).
    """

    def __init__(self, net: nn.Module, encoder: nn.Module) -> None:
        super().__init__()
        self.net, self.encoder = net, encoder

    def forward(self, observation: Tensor) -> Tensor:
        """Return SB3's latent of the actor."""
        return self.net(torch.cat([observation, self.encoder(observation).detach()], dim=-1))


class TwoNetworks(MlpExtractor):
    """SB3's two networks, of which the actor may see fewer columns, and with bfloat16 as a choice.

    Args:
        policy_size: the first columns that are the actor's; None for all of them.
        bf16: multiply matrices in bfloat16 while training; weights and everything else stay float32.
        estimator: of the actor.
        critic_widths: of the terms that the critic alone sees; one by default.
    """

    policy_net: nn.Module  # type: ignore[assignment]  # SB3's is always a Sequential
    decoder: nn.Linear
    _shares: Tensor

    def __init__(
        self,
        size: int,
        arch: Any,
        activation: type[nn.Module],
        device: torch.device | str,
        *,
        policy_size: int | None,
        bf16: bool,
        estimator: EstimatorConfig,
        critic_widths: Sequence[int] = (),
    ) -> None:
        super().__init__(size, arch, activation, device)
        self._policy_size, self._bf16, self._estimates = policy_size, bf16, estimator.latent > 0
        if policy_size is None:
            return
        net = MlpExtractor(policy_size + estimator.latent, arch, activation, device).policy_net
        self.policy_net = net
        if not self._estimates:
            return
        encoder = nn.Sequential(*create_mlp(policy_size, estimator.latent, list(estimator.hidden), activation))
        self.policy_net = EstimatingActor(net, encoder)
        self.decoder = nn.Linear(estimator.latent, size - policy_size)
        widths = critic_widths or [size - policy_size]
        shares = [torch.full((width,), 1.0 / (width * len(widths))) for width in widths]
        self.register_buffer("_shares", torch.cat(shares), persistent=False)
        self.to(device)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the latents of actor and critic, float32."""
        if not self._bf16:
            return super().forward(features)
        with torch.autocast(features.device.type, torch.bfloat16, enabled=self.training):
            pi, vf = super().forward(features)
        return pi.float(), vf.float()

    def forward_actor(self, features: Tensor) -> Tensor:
        """Return the actor's latent; columns of the critic may be missing."""
        return self.policy_net(features[..., : self._policy_size])

    def estimate(self, observation: Tensor) -> Tensor:
        """Return what the estimator takes the critic's own columns for, (N, C), from observations (N, P or more)."""
        assert isinstance(self.policy_net, EstimatingActor)
        return self.decoder(self.policy_net.encoder(observation[..., : self._policy_size]))

    def estimation_loss(self, features: Tensor) -> Tensor:
        """Return the mean square error of the estimate, (), in which each term counts the same; 0 without estimator."""
        if not self._estimates:
            return torch.zeros((), device=features.device)
        error = self.estimate(features) - features[..., self._policy_size :]
        return (error.square() @ self._shares).mean()


class GaussianPolicy(ActorCriticPolicy):
    """SB3's actor-critic, which remembers the distribution of its last forward pass.

    Args:
        *args: SB3's.
        policy_size: columns of the observation that the actor sees, the first ones; the critic sees all.
        bf16: as for ``TwoNetworks``, and so are the next two.
        estimator: of the actor.
        critic_widths: of the terms that the critic alone sees.
        **kwargs: SB3's.
    """

    mlp_extractor: TwoNetworks
    last_distribution: DiagGaussianDistribution

    def __init__(
        self,
        *args: Any,
        policy_size: int | None = None,
        bf16: bool = False,
        estimator: EstimatorConfig = EstimatorConfig(),  # noqa: B008 (frozen)
        critic_widths: Sequence[int] = (),
        **kwargs: Any,
    ) -> None:
        self._networks: dict[str, Any] = {
            "policy_size": policy_size,
            "bf16": bf16,
            "estimator": estimator,
            "critic_widths": critic_widths,
        }
        self.estimator = estimator
        super().__init__(*args, **kwargs)

    def _build_mlp_extractor(self) -> None:
        arch, activation, device = self.net_arch, self.activation_fn, self.device
        self.mlp_extractor = TwoNetworks(self.features_dim, arch, activation, device, **self._networks)

    def _get_action_dist_from_latent(self, latent_pi: Tensor) -> Distribution:
        distribution = super()._get_action_dist_from_latent(latent_pi)
        assert isinstance(distribution, DiagGaussianDistribution)
        self.last_distribution = distribution
        return distribution
