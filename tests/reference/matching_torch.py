"""The evaluator in PyTorch with the published names of its arrays, made of its layers.

Import only after `pytest.importorskip("torch")`.
"""

import torch
from torch import nn


class Movement(nn.Module):
    def __init__(self, features, width):
        super().__init__()
        layers = []
        for channels in (features, width):
            layers.append(nn.Conv1d(channels, width, 4, stride=2, padding=1))
            layers += [nn.Dropout(0.2), nn.LeakyReLU(0.2)]
        self.main = nn.Sequential(*layers)
        self.out_net = nn.Linear(width, width)

    def forward(self, x):
        return self.out_net(self.main(x.mT).mT)


class Sequence(nn.Module):
    def __init__(self, channels, width, embedding, tags=0):
        super().__init__()
        self.input_emb = nn.Linear(channels, width)
        self.gru = nn.GRU(width, width, batch_first=True, bidirectional=True)
        self.hidden = nn.Parameter(torch.randn(2, 1, width))
        self.output_net = nn.Sequential(
            nn.Linear(2 * width, width),
            nn.LayerNorm(width),
            nn.LeakyReLU(0.2),
            nn.Linear(width, embedding),
        )
        nn.init.normal_(self.output_net[1].weight)
        nn.init.normal_(self.output_net[1].bias)
        if tags:
            self.pos_emb = nn.Linear(tags, channels)

    def forward(self, x, length):
        packed = nn.utils.rnn.pack_padded_sequence(
            self.input_emb(x), length, batch_first=True, enforce_sorted=False
        )
        start = self.hidden.expand(-1, len(x), -1).contiguous()
        _, last = self.gru(packed, start)
        return self.output_net(torch.cat([last[0], last[1]], dim=-1))


class Evaluator:
    """The three encoders of a `MatcherConfig`, with random weights."""

    def __init__(self, config, seed=0):
        torch.manual_seed(seed)
        self.movement = Movement(config.num_features, config.movement_width).eval()
        self.motion = Sequence(
            config.movement_width, config.motion_width, config.embedding
        ).eval()
        self.text = Sequence(300, config.text_width, config.embedding, tags=15).eval()

    def state_dicts(self):
        return {
            "movement_encoder": self.movement.state_dict(),
            "motion_encoder": self.motion.state_dict(),
            "text_encoder": self.text.state_dict(),
        }

    @torch.inference_mode()
    def embed_motion(self, features, frames):
        movements = self.movement(torch.from_numpy(features))
        return self.motion(movements, torch.from_numpy(frames) // 4).numpy()

    @torch.inference_mode()
    def embed_text(self, vectors, tags, words):
        x = torch.from_numpy(vectors) + self.text.pos_emb(torch.from_numpy(tags))
        return self.text(x, torch.from_numpy(words)).numpy()
