"""ARIG: a listener and speaker frame by frame, motion drawn from a diffusion head.

Sections of the paper and the files that follow them:

    3.1, (1), (2)   what a frame is made from            model.py; streaming: stream.py
    3.2             interactive behaviour understanding  modules.py, ShortRange and LongRange
    3.3             conversational states                modules.py, StateUnderstanding
    3.4             progressive motion prediction        modules.py, Progressive
    3.4, (3), (4)   diffusion head                       sampler.py
    ours            curves of events                     event_curves.py
    ours            networks of a stream, 8-bit layers   networks.py
"""
