"""Released networks of layers of PyTorch, with the published names of their arrays.

Import only after `pytest.importorskip("torch")`. Written from the facts of the released
code: names, shapes, order of tokens.
"""

import numpy as np
import torch
from torch import nn


def positions(length, width):
    rate = torch.exp(torch.arange(0, width, 2) * (-np.log(10000.0) / width))
    angle = torch.arange(length)[:, None] * rate
    return torch.stack([angle.sin(), angle.cos()], -1).reshape(length, 1, width)


class Holder(nn.Module):
    """A module for the sake of its name."""

    def __init__(self, **modules):
        super().__init__()
        for name, module in modules.items():
            self.add_module(name, module)


class Positions(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.register_buffer("pe", positions(200, width).float())


def time_layers(width):
    return nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))


def encoder(width, depth, heads, hidden, activation):
    layer = nn.TransformerEncoderLayer(width, heads, hidden, 0.1, activation)
    return nn.TransformerEncoder(layer, depth, enable_nested_tensor=False)


def randomize(module, seed, scale=0.1):
    """Norms and biases too; the layers of an encoder are made equal otherwise."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for array in module.parameters():
            if array.ndim < 2:
                array.add_(torch.randn(array.shape, generator=generator) * scale)
            else:
                fan = max(array.shape[-1], 4)
                array.copy_(torch.randn(array.shape, generator=generator) / fan**0.5)
        for name, array in module.named_buffers():
            if name.endswith("running_mean"):
                array.copy_(torch.randn(array.shape, generator=generator))
            if name.endswith("running_var"):
                array.copy_(torch.rand(array.shape, generator=generator) + 0.2)
    return module.eval()


class Camdm(nn.Module):
    def __init__(self, joints, styles, width=16, depth=2, heads=4, hidden=24):
        super().__init__()
        self.joints, features = joints, 6 * (joints + 1)
        for stream in ("future_motion", "past_motion", "traj_trans", "traj_pose"):
            size = {"traj_trans": 2, "traj_pose": 6}.get(stream, features)
            embedding = Holder(poseEmbedding=nn.Linear(size, width))
            self.add_module(f"{stream}_process", embedding)
        self.sequence_pos_encoder = Positions(width)
        self.embed_style = nn.Module()
        self.embed_style.action_embedding = nn.Parameter(torch.zeros(styles, width))
        self.embed_timestep = Holder(
            sequence_pos_encoder=self.sequence_pos_encoder,
            time_embed=time_layers(width),
        )
        self.seqEncoder = encoder(width, depth, heads, hidden, "gelu")
        self.output_process = Holder(poseFinal=nn.Linear(width, features))

    def forward(self, x, steps, past, traj_pose, traj_trans, style):
        """Poses are [batch, joints + 1, 6, frames]; steps count from 0."""
        frames = x.shape[-1]
        flat = lambda y: y.permute(3, 0, 1, 2).flatten(2)  # noqa: E731
        rows = lambda y: y.permute(2, 0, 1)  # noqa: E731
        table = self.sequence_pos_encoder.pe
        tokens = torch.cat(
            [
                self.embed_timestep.time_embed(table[steps]).transpose(0, 1),
                self.embed_style.action_embedding[style][None],
                self.traj_trans_process.poseEmbedding(rows(traj_trans)),
                self.traj_pose_process.poseEmbedding(rows(traj_pose)),
                self.past_motion_process.poseEmbedding(flat(past)),
                self.future_motion_process.poseEmbedding(flat(x)),
            ]
        )
        seen = self.seqEncoder(tokens + table[: len(tokens)])[-frames:]
        out = self.output_process.poseFinal(seen)
        return out.reshape(frames, -1, self.joints + 1, 6).permute(1, 2, 3, 0)


class EmdmGenerator(nn.Module):
    """kind: "text" or "action"."""

    def __init__(self, kind, size, features, width=16, depth=2, heads=4, latent=5):
        super().__init__()
        self.input_process = Holder(poseEmbedding=nn.Linear(features, width))
        self.sequence_pos_encoder = Positions(width)
        self.seqTransEncoder = encoder(width, depth, heads, 24, nn.SELU())
        self.embed_timestep = Holder(
            sequence_pos_encoder=self.sequence_pos_encoder,
            time_embed=time_layers(width),
        )
        if kind == "text":
            self.embed_text = nn.Linear(size, width)
            self.clip_model = Holder(ln_final=nn.LayerNorm(3))  # saved with the others
        else:
            self.embed_action = nn.Module()
            self.embed_action.action_embedding = nn.Parameter(torch.zeros(size, width))
        self.output_process = Holder(poseFinal=nn.Linear(width, features))
        layers = []
        for i in range(5):
            layers += [nn.Linear(width if i else latent, width), nn.LeakyReLU(0.2)]
        self.z_transform = nn.Sequential(*layers)

    def forward(self, x, steps, latent, condition):
        """x is [batch, J, D, frames]; the condition vectors, or numbers of actions."""
        table = self.sequence_pos_encoder.pe
        if condition.dtype == torch.int64:
            token = self.embed_action.action_embedding[condition]
        else:
            token = self.embed_text(condition)
        time = self.embed_timestep.time_embed(table[steps]).transpose(0, 1)
        frames = self.input_process.poseEmbedding(x.permute(3, 0, 1, 2).flatten(2))
        own = torch.cat([time, token[None], self.z_transform(latent)[None]])
        tokens = torch.cat([own, frames])
        seen = self.seqTransEncoder(tokens + table[: len(tokens)])[3:]
        out = self.output_process.poseFinal(seen)
        return out.reshape(x.shape[-1], len(x), *x.shape[1:3]).permute(1, 2, 3, 0)


class EmdmDiscriminator(nn.Module):
    def __init__(self, inputs, full=64):
        super().__init__()
        time = nn.Sequential(
            nn.Linear(128, 128), nn.LeakyReLU(0.2), nn.Linear(128, 128)
        )
        self.t_embed = Holder(main=time)
        sizes = (
            inputs + 128,
            full,
            full,
            full // 2,
            full // 2,
            full // 4,
            full // 16,
            1,
        )
        for i in range(7):
            self.add_module(f"fc{i + 1}", nn.Linear(sizes[i], sizes[i + 1]))
        self.gn1 = nn.GroupNorm(full // 32, full)
        self.gn2 = nn.GroupNorm(full // 64, full // 2)

    def forward(self, x_prev, x_t, steps, condition):
        rate = torch.exp(torch.arange(64) * (-np.log(10000.0) / 63))
        angle = steps[:, None] * rate
        time = self.t_embed.main(torch.cat([angle.sin(), angle.cos()], 1).float())
        h = torch.cat([x_prev.flatten(1), x_t.flatten(1), time, condition], 1)
        norms = {2: self.gn1, 4: self.gn2}
        for i in range(1, 7):
            h = self.get_submodule(f"fc{i}")(h)
            h = nn.functional.selu(norms[i](h) if i in norms else h)
        return self.fc7(h)[:, 0]


class StyleClassifier(nn.Module):
    def __init__(self, channels=45, classes=100, frames=60):
        super().__init__()
        self.conv1 = nn.Conv1d(channels, 64, 3, padding=1)
        self.bn1 = nn.BatchNorm1d(64)
        self.conv2 = nn.Conv1d(64, 128, 3, padding=1)
        self.bn2 = nn.BatchNorm1d(128)
        self.residual1x1_1 = nn.Conv1d(channels, 64, 1)
        self.residual1x1_2 = nn.Conv1d(64, 128, 1)
        self.fc1 = nn.Linear(128 * frames, 1024)
        self.bn3 = nn.BatchNorm1d(1024)
        self.fc2 = nn.Linear(1024, 512)
        self.bn4 = nn.BatchNorm1d(512)
        self.fc3 = nn.Linear(512, classes)

    def forward(self, x):
        """x is [batch, channels, frames]."""
        act = nn.functional.leaky_relu
        x = act(self.bn1(self.conv1(x))) + self.residual1x1_1(x)
        x = act(self.bn2(self.conv2(x))) + self.residual1x1_2(x)
        x = act(self.bn3(self.fc1(x.flatten(1))))
        features = act(self.bn4(self.fc2(x)))
        return features, self.fc3(features)


class ClipBlock(nn.Module):
    def __init__(self, width, heads):
        super().__init__()
        self.attn = nn.MultiheadAttention(width, heads)
        self.ln_1 = nn.LayerNorm(width)
        self.mlp = Holder(c_fc=nn.Linear(width, 4 * width))
        self.mlp.add_module("c_proj", nn.Linear(4 * width, width))
        self.ln_2 = nn.LayerNorm(width)

    def forward(self, x, mask):
        y = self.ln_1(x)
        x = x + self.attn(y, y, y, need_weights=False, attn_mask=mask)[0]
        y = self.mlp.c_fc(self.ln_2(x))
        return x + self.mlp.c_proj(y * torch.sigmoid(1.702 * y))


class ClipText(nn.Module):
    """OpenAI's text tower, with the beginning of an image tower beside it."""

    def __init__(self, vocabulary, context, width, depth, dimensions):
        super().__init__()
        self.visual = Holder(ln_pre=nn.LayerNorm(3))
        blocks = [ClipBlock(width, width // 64) for _ in range(depth)]
        self.transformer = Holder(resblocks=nn.ModuleList(blocks))
        self.token_embedding = nn.Embedding(vocabulary, width)
        self.positional_embedding = nn.Parameter(torch.zeros(context, width))
        self.ln_final = nn.LayerNorm(width)
        self.text_projection = nn.Parameter(torch.zeros(width, dimensions))
        self.logit_scale = nn.Parameter(torch.ones([]))

    def forward(self, ids):
        x = self.token_embedding(ids) + self.positional_embedding[: ids.shape[1]]
        x = x.transpose(0, 1)
        mask = torch.full((len(x), len(x)), float("-inf")).triu(1)
        for block in self.transformer.resblocks:
            x = block(x, mask)
        x = self.ln_final(x.transpose(0, 1))
        row = x[torch.arange(len(ids)), ids.argmax(-1)]
        return row @ self.text_projection
