"""SFMS: listening motion as sparse keyframe tokens, and a predictor of the next tokens.

Sections of the paper and the files that follow them:

    IV-A   features of sound                         audio_frontend.py (shared with ARIG)
    IV-B2  keyframe discovery                        placement.py, piecewise_linear.py
    IV-B4  codes of keyframes                        quantizer.py
    IV-B5  from keyframes to every frame             model.py
    IV-C   predictor of listening motion             predictor.py
    ours   drawing tokens, and running as a stream   draw.py, stream.py
"""
